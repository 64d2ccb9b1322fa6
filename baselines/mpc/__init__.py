"""Nonlinear model-predictive control with CasADi."""
