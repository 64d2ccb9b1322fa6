"""The controllers of a whole crystal with their settings, tuned by hand on the first training crystals."""

from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.baselines.pid.temperature_loop import TemperatureLoop
from cz_gym.support.units import MM, MM_PER_MIN

from .lqg import CrystalLQG, Noise, Weights
from .pid import CrystalPID, TrueRadiusPID

HEATER = TemperatureLoop(K=1500.0, T_i=300.0, K_pull=10.0, T_pull=2000.0, T_mean=300.0)
"""The heater's loop on the recipe, trimmed where the mean pull speed is off the recipe's."""
CONVENTIONAL = SeriesPID(K_p=0.0018, T_i=2000.0, T_d=1069.0, N=25.0)
"""Gains of ``pid-conventional`` of ``Cz-v0``, which needs no compensator, with a slower integrator."""
COMPENSATED = SeriesPID(K_p=0.008, T_i=1500.0, T_d=800.0, N=12.0)
"""Gains near those of the paper, with a slower derivative filter."""
RING_PID = CrystalPID(pid=CONVENTIONAL, compensates=False, T_f=10.0, heater=HEATER)
REDUCED_PID = CrystalPID(pid=CONVENTIONAL, compensates=False, T_f=10.0, cone_gain=0.15, heater=HEATER)
COMPENSATED_PID = CrystalPID(pid=COMPENSATED, lam=0.1, slow=1.0e-3, cone_gain=0.15, heater=HEATER)
TRUE_PID = TrueRadiusPID(pid=SeriesPID(N=10.0), heater=HEATER)
LQG_ALONG = CrystalLQG(
    lam=0.1,
    noise=Noise(height=4.0e-5, temperature=1.0e-3, load=800.0),
    weights=Weights(radius=0.4 * MM, height=0.3 * MM, pull=0.1 * MM_PER_MIN),
)
