"""Linear-quadratic-Gaussian control: model, Kalman filter, regulator, shipped settings."""
