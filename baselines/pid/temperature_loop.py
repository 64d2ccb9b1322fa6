"""The heater of a puller: a PI loop on the pyrometer, and automatic growth control.

Automatic growth control raises the temperature's set-point while the mean pull speed is above nominal. Temperatures
[K], powers [W], speeds [m/s], all as deviations from the puller's nominal.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cz_gym.baselines.policy import Floats, check_numbers
from cz_gym.observation import Measured
from cz_gym.support.units import KILO


class Heat(NamedTuple):
    """The memory of the loop; each of shape (n,)."""

    integral: Floats
    """Integral of the temperature error, over T_i [K]."""
    command: Floats
    """Last commanded power [W]."""
    mean_pull: Floats
    """Averaged pull speed over v_0, minus one [-]."""
    trim: Floats
    """Integral part of the set-point's trim [K]."""


@dataclass(frozen=True)
class TemperatureLoop:
    """Q_H = Q_H0 + K (1 + 1/(T_i s)) (T_1,set - T_1), T_1,set = share T_1,ref + trim.

    trim = K_pull (1 + 1/(T_pull s)) m, with m the pull speed's relative deviation behind a first-order filter T_mean;
    ``K_pull = 0`` is no trim. Forward Euler; back-calculation from the applied power limits the integrator, ``limit``
    the trim.
    """

    K: float = 1.0 * KILO
    """Gain [W/K]."""
    T_i: float = 300.0
    """Integral time [s]."""
    T_track: float = 60.0
    """Time constant with which the integrator follows a limited drive [s]."""
    share: float = 1.0
    """Share of the recipe's change that is followed [-]."""
    K_pull: float = 0.0
    """Trim per relative deviation of the mean pull speed [K]."""
    T_pull: float = 3000.0
    """Integral time of the trim [s]."""
    T_mean: float = 300.0
    """Averaging time of the pull speed [s]."""
    limit: float = 15.0
    """Largest integral part of the trim [K]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("K", "T_i", "T_track", "T_pull", "T_mean"), not_negative=("K_pull", "limit"))

    def at_rest(self, seen: Measured) -> Heat:
        """The memory before the first sample: the applied power continues."""
        zero = np.zeros_like(seen.T_1)
        return Heat(seen.Q_H / self.K, np.copy(seen.Q_H), zero, zero)

    def step(self, seen: Measured, memory: Heat, dt: float, v_0: float, heater_range: float) -> tuple[Floats, Heat]:
        """Power above nominal [W], shape (n,), and the new memory; dt in s, v_0 in m/s, the heater's range in W."""
        mean = memory.mean_pull - math.expm1(-dt / self.T_mean) * (seen.v_p / v_0 - memory.mean_pull)
        before = memory.trim if self.K_pull > 0.0 else 0.0
        trim = np.clip(before + self.K_pull * dt / self.T_pull * mean, -self.limit, self.limit)
        error = self.share * seen.T_1_ref + self.K_pull * mean + trim - seen.T_1
        missed = (seen.Q_H - memory.command) / self.K
        integral = memory.integral + min(dt / self.T_track, 1.0) * missed
        power = self.K * (error + integral)
        integral = integral + dt / self.T_i * error
        return power, Heat(integral, np.clip(power, -2.0 * heater_range, 2.0 * heater_range), mean, trim)
