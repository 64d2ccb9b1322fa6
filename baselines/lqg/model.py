"""The LQG's model of the plant: linearised, sampled, and augmented by disturbance states.

x = (r_c, h_c, T_1, T_2, T_b, fast, slow, drift, drift_rate, heater), deviations from the operating point, SI units:
two Ornstein-Uhlenbeck fluctuations of the interface temperature [K], the hot zone's drift p [K], its rate [K/s] (a slow
Ornstein-Uhlenbeck process, so the drift is a slowly bending ramp), and an unknown heater power [W] (a random walk that
removes the offset between T_1 and the pyrometer). The drift also follows a share of the recipe's known movement.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.signal import cont2discrete

from cz_gym.baselines.policy import Floats, check_numbers
from cz_gym.body.linearisation import INPUTS, OUTPUTS, linearise
from cz_gym.body.plant import Puller, hidden_load
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.support.units import MINUTE, MM

STATES = ("r_c", "h_c", "T_1", "T_2", "T_b", "fast", "slow", "drift", "drift_rate", "heater")
"""States of the augmented plant."""
PLANT = 5
"""Number of the plant's own states, which come first."""
FAST, SLOW, DRIFT, DRIFT_RATE, HEATER = range(PLANT, len(STATES))
_STEP = 1e-30


@dataclass(frozen=True)
class NoiseModel:
    """The Kalman filter's model of disturbances and sensors; tuned, not derived from a scenario."""

    fast_sd: float = 0.25
    """Standard deviation of the fast interface fluctuation [K]."""
    fast_tau: float = 30.0
    """Correlation time of the fast interface fluctuation [s]."""
    slow_sd: float = 0.3
    """Standard deviation of the slow interface fluctuation [K]."""
    slow_tau: float = 780.0
    """Correlation time of the slow interface fluctuation [s]."""
    drift_rate_sd: float = 0.02 / MINUTE
    """Standard deviation of the drift's rate [K/s]; the loop fails if it is too large."""
    drift_rate_tau: float = 40.0 * MINUTE
    """Correlation time of the drift's rate [s]."""
    heater_walk: float = 1.0
    """Random walk of the heater's power balance [W/sqrt(s)]."""
    thermal_walk: float = 0.004
    """Random walk of the three temperatures, for the puller's unknown conductances [K/sqrt(s)]."""
    recipe_share: float = 0.5
    """Share of the recipe's movement that the drift follows [-]."""
    camera_sd: float = 0.025 * MM
    """Initial estimate of the camera noise's standard deviation [m]."""
    camera_sd_range: tuple[float, float] = (0.005 * MM, 0.2 * MM)
    """Lower and upper limit of that estimate [m]."""
    camera_memory: float = 10.0 * MINUTE
    """Averaging time of that estimate [s]; infinite for a constant one."""
    pyrometer_sd: float = 0.1
    """Standard deviation of the pyrometer's noise [K]."""
    start_radius_sd: float = 0.2 * MM
    """Standard deviation of the initial radius [m]."""

    def __post_init__(self) -> None:
        taus = ("fast_tau", "slow_tau", "drift_rate_tau", "camera_memory")
        walks = ("heater_walk", "thermal_walk", "start_radius_sd")
        check_numbers(self, (*taus, "camera_sd", "pyrometer_sd"), ("fast_sd", "slow_sd", "drift_rate_sd", *walks))


class PlantModel(NamedTuple):
    """x_{k+1} = A x_k + B u_k + w_k, y_k = H x_k + v_k with u = (v_p, Q_H) and y = (r_br, T_1); SI units.

    A has shape (10, 10), B (10, 2), H (2, 10). Q is the covariance of w over one interval, ``start`` that of x at the
    start of an episode.
    """

    A: Floats
    B: Floats
    H: Floats
    Q: Floats
    start: Floats


def load_per_drift(puller: Puller) -> Any:
    """dQ_d/dp at p = 0 [W/K] for one puller or many, by complex step through :func:`hidden_load`."""
    return np.imag(hidden_load(complex(0.0, _STEP), puller)) / _STEP


def plant_model(puller: Puller, noise: NoiseModel, dt: float, meniscus: MeniscusModel = HURLE) -> PlantModel:
    """The augmented plant at the puller's operating point, with inputs held over dt [s] and exactly sampled noise."""
    F, G, H = _continuous(puller, noise, meniscus)
    W = np.zeros(len(STATES))
    W[2:PLANT] = noise.thermal_walk**2
    W[FAST] = 2.0 * noise.fast_sd**2 / noise.fast_tau
    W[SLOW] = 2.0 * noise.slow_sd**2 / noise.slow_tau
    W[DRIFT_RATE] = 2.0 * noise.drift_rate_sd**2 / noise.drift_rate_tau
    W[HEATER] = noise.heater_walk**2
    start = np.zeros(len(STATES))
    start[0] = noise.start_radius_sd
    start[[FAST, SLOW, DRIFT_RATE]] = noise.fast_sd, noise.slow_sd, noise.drift_rate_sd
    A, B, *_ = cont2discrete((F, G, H, np.zeros((2, 2))), dt, method="zoh")
    return PlantModel(A, B, H, sampled_noise(F, np.diag(W), dt), np.diag(start**2))


def sampled_noise(F: Floats, W: Floats, dt: float) -> Floats:
    """Integral of exp(F s) W exp(F' s) over dt [s], with W the intensity of white noise (Van Loan 1978)."""
    n = len(F)
    both = expm(np.block([[-F, W], [np.zeros((n, n)), F.T]]) * dt)
    Q: Floats = both[n:, n:].T @ both[:n, n:]
    return 0.5 * (Q + Q.T)


def _continuous(puller: Puller, noise: NoiseModel, meniscus: MeniscusModel) -> tuple[Floats, Floats, Floats]:
    plant = linearise(puller, meniscus)
    column = {name: plant.B[:, INPUTS.index(name)] for name in INPUTS}
    n = len(STATES)
    F, G, H = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((2, n))
    F[:PLANT, :PLANT] = plant.A
    F[:PLANT, FAST] = F[:PLANT, SLOW] = column["dT_i"]
    F[:PLANT, DRIFT] = column["Q_d"] * load_per_drift(puller)
    F[:PLANT, HEATER] = column["Q_H"]
    F[FAST, FAST], F[SLOW, SLOW] = -1.0 / noise.fast_tau, -1.0 / noise.slow_tau
    F[DRIFT, DRIFT_RATE], F[DRIFT_RATE, DRIFT_RATE] = 1.0, -1.0 / noise.drift_rate_tau
    G[:PLANT, 0], G[:PLANT, 1] = column["v_p"], column["Q_H"]
    H[0, :PLANT] = plant.C[OUTPUTS.index("r_br")]
    H[1, STATES.index("T_1")] = 1.0
    return F, G, H
