"""The controllers of a whole crystal with their settings, tuned by hand on the first training crystals."""

from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.baselines.pid.temperature_loop import TemperatureLoop
from cz_gym.support.units import MM, MM_PER_MIN

from .lqg import CrystalLQG, Noise, Weights
from .pid import CrystalPID, TrueRadiusPID

HEATER = TemperatureLoop(K=1500.0, T_i=300.0, K_pull=10.0, T_pull=2000.0, T_mean=300.0)
"""The heater's loop on the recipe, trimmed where the mean pull speed is off the recipe's."""
BODY_GAINS = SeriesPID(N=10.0)
"""Table 1 of the paper, with a slower derivative filter."""
RING_PID = CrystalPID(pid=BODY_GAINS, compensates=False, heater=HEATER)
REDUCED_PID = CrystalPID(pid=BODY_GAINS, compensates=False, cone_gain=0.15, heater=HEATER)
COMPENSATED_PID = CrystalPID(pid=BODY_GAINS, lam=0.2, cone_gain=0.15, heater=HEATER)
TRUE_PID = TrueRadiusPID(pid=BODY_GAINS, heater=HEATER)
LQG_ALONG = CrystalLQG(
    lam=0.1,
    noise=Noise(height=4.0e-5, temperature=1.0e-3, load=800.0),
    weights=Weights(radius=0.4 * MM, height=0.3 * MM, pull=0.1 * MM_PER_MIN),
)
