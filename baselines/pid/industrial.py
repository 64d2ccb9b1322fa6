"""The diameter control of a production puller: an incremental pull-speed law, and automatic growth control.

The law and its numbers come from a public analysis of 38 logged silicon body segments (GitHub,
Tommy840602/czochralski-virtual-plc, docs/control_analysis.md). It speaks of diameters in mm and of pull speed in
mm/min, and acts every 5 s; at other control intervals each increment is scaled by the interval.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, MeasuredController, check_numbers
from cz_gym.observation import Measured
from cz_gym.support.units import MINUTE, MM, MM_PER_MIN

from .temperature_loop import Heat, TemperatureLoop

LAW_INTERVAL = 5.0
"""Time between increments of the logged law [s]."""
RATE_INTERVAL = 10.0
"""Time that the law's rates refer to [s]: (now - 60 s ago) / 6 is a change per 10 s."""


class Memory(NamedTuple):
    """The memory of :class:`Industrial`; each of shape (n,) but ``diameters``, (n, samples in 60 s)."""

    mean: Floats
    """Averaged diameter error [mm]."""
    diameters: Floats
    """Averaged diameters of the last 60 s, oldest first, above 2 r_0 [mm]."""
    rate: Floats
    """Exponentially averaged rate of the diameter [mm per 10 s]."""
    heat: Heat


def dead_zone(error: npt.ArrayLike) -> Floats:
    """E of the diameter error e [mm]: 2 e up to 1 mm, flat (the dead zone) at +-2 from there to 2 mm, +-3 beyond."""
    e = np.multiply(error, 1.0)
    return np.where(np.abs(e) >= 2.0, 3.0 * np.sign(e), np.clip(2.0 * e, -2.0, 2.0))


@dataclass(frozen=True)
class Industrial(MeasuredController):
    """v_p = applied v_p + 1.15 (G_p E + G_v dD60 + G_d dDbar) every 5 s; being incremental, it cannot wind up.

    dD60 = (averaged diameter now - 60 s ago)/6, dDbar the exponentially averaged rate, both per 10 s; E as in
    :func:`dead_zone`. Heater: :class:`TemperatureLoop` with its trim, the automatic growth control.
    """

    gain: float = 1.15
    """Common gain of the increment [-]."""
    G_p: float = 0.0004
    """Gain on E [mm/min per mm]."""
    G_v: float = 0.16
    """Gain on the rate over 60 s [mm/min per mm/10 s]."""
    G_d: float = -0.1064
    """Gain on the averaged rate [mm/min per mm/10 s]."""
    forgetting: float = 1.0 / 24.0
    """Share of the newest rate in the averaged one, every 5 s [-]."""
    T_f: float = 10.0
    """Averaging time of the diameter [s], about two revolutions of the crystal; the logs do not give it."""
    heater: TemperatureLoop = field(default_factory=TemperatureLoop)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, positive=("gain", "T_f", "forgetting"))

    @property
    def samples(self) -> int:
        """Number of samples in 60 s."""
        return max(round(MINUTE / self.control_interval), 1)

    def at_rest(self, seen: Measured) -> Memory:
        """The first diameter counts as the one of the last minute; the applied power continues."""
        diameter = 2.0 * (seen.r_ref + seen.ring_error) / MM
        diameters = np.repeat(diameter[:, None], self.samples, axis=1)
        return Memory(diameter, diameters, np.zeros_like(diameter), self.heater.at_rest(seen))

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        dt = self.control_interval
        target = 2.0 * seen.r_ref / MM
        diameter = target + 2.0 * seen.ring_error / MM
        mean = memory.mean - math.expm1(-dt / self.T_f) * (diameter - memory.mean)
        over_minute = (mean - memory.diameters[:, 0]) * (RATE_INTERVAL / (self.samples * dt))
        share = 1.0 - (1.0 - self.forgetting) ** (dt / LAW_INTERVAL)
        newest = (mean - memory.mean) * (RATE_INTERVAL / dt)
        rate = memory.rate + share * (newest - memory.rate)
        rise = self.G_p * dead_zone(mean - target) + self.G_v * over_minute + self.G_d * rate
        pull = seen.v_p + self.gain * rise * (dt / LAW_INTERVAL) * MM_PER_MIN
        power, heat = self.heater.step(seen, memory.heat, dt, self.v_0, self.heater_range)
        diameters = np.concatenate([memory.diameters[:, 1:], mean[:, None]], axis=1)
        return pull, power, Memory(mean, diameters, rate, heat)
