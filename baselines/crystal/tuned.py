"""The controllers of a whole crystal with their settings, tuned by hand on the first training crystals."""

from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.baselines.pid.temperature_loop import TemperatureLoop

from .lqg import CrystalLQG
from .pid import CrystalPID, TrueRadiusPID

HEATER = TemperatureLoop(K=1500.0, T_i=300.0, K_pull=20.0, T_pull=1000.0, T_mean=200.0)
"""The heater's loop on the recipe, trimmed where the mean pull speed is off the recipe's."""
RING_PID = CrystalPID(compensates=False, heater=HEATER)
REDUCED_PID = CrystalPID(compensates=False, cone_gain=0.15, heater=HEATER)
COMPENSATED_PID = CrystalPID(cone_gain=0.3, heater=HEATER)
TRUE_PID = TrueRadiusPID(pid=SeriesPID(), heater=HEATER)
LQG_ALONG = CrystalLQG()
