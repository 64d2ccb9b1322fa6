"""The paper's controller made fit for service: measurement filter, anti-windup, bumpless start, trim of the recipe.

With ``compensator=None`` it is a conventional PID. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cz_gym.baselines.policy import Floats, MeasuredController, check_numbers
from cz_gym.body.linearisation import radius_model
from cz_gym.body.plant import make_puller
from cz_gym.observation import PREVIEWS, Measured

from .compensated_pid import Compensator, PIDState, SeriesPID, compensated_error
from .temperature_loop import Heat, TemperatureLoop


class Memory(NamedTuple):
    """The memory of :class:`FilteredPID`; each of shape (n,) but the compensator's state, (n, 2)."""

    compensator: Floats
    """State of the compensator."""
    filtered: Floats
    """Filtered radius error [m]."""
    start: Floats
    """Part of the error at the first sample that is still subtracted [m]."""
    pid: PIDState
    command: Floats
    """Last commanded pull speed above nominal [m/s]."""
    heat: Heat


@dataclass(frozen=True)
class FilteredPID(MeasuredController):
    """v_p = v_0 + K F e + feed-forward, with e = r_tilde - r_target and F = 1/(1 + T_f s).

    r_target = r_ref + ring_lead d(r_ref)/dt. The error at the first sample is subtracted and returns over T_start, and
    the integrator starts at the applied pull speed, so that switching on moves no drive. The integrator follows the
    applied pull speed (window, slew rate, drive limits) within T_track.
    """

    pid: SeriesPID = field(default_factory=SeriesPID)
    compensator: Compensator | None = field(default_factory=Compensator)
    T_f: float = 20.0
    """Time constant of the measurement filter [s]; 0 for none."""
    jump: float = math.inf
    """Largest difference between reading and filter that counts [m]."""
    T_start: float = 0.0
    """Time constant with which the error at the first sample returns [s]; 0 for at once."""
    T_track: float = 600.0
    """Time constant with which the integrator follows a limited drive [s]."""
    ring_lead: float = 0.0
    """Lead of the ring's target on a moving reference [s]; the lead coefficient of G_m is -46 s."""
    K_ff: float = 0.0
    """Feed-forward of the reference's acceleration, in multiples of the inverse plant [-]."""
    heater: TemperatureLoop = field(default_factory=TemperatureLoop)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, positive=("jump", "T_track"), not_negative=("T_f", "T_start"))

    @cached_property
    def plant_gain(self) -> float:
        """Numerator b of G_p [1/s] on Model II, where r'' = b (v_p - v_0)."""
        return radius_model(make_puller(self.parameters, 0.0, self.meniscus), self.meniscus).numerator

    def at_rest(self, seen: Measured) -> Memory:
        """The applied pull speed and power continue."""
        zero = np.zeros_like(seen.v_p)
        start = seen.ring_error if self.T_start > 0.0 else zero
        pid = PIDState(zero, zero, seen.v_p / self.pid.K_p)
        return Memory(np.zeros((len(zero), 2)), zero, start, pid, seen.v_p, self.heater.at_rest(seen))

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        dt = self.control_interval
        slope, curvature = reference_derivatives(seen)
        error, compensator = compensated_error(self.compensator, seen, memory.compensator, dt)
        # A first-order low-pass, exact for a held input, which counts up to ``jump`` from the filter's output.
        pace = -math.expm1(-dt / self.T_f) if self.T_f > 0.0 else 1.0
        away = error - self.ring_lead * slope - memory.start - memory.filtered
        filtered = memory.filtered + pace * np.clip(away, -self.jump, self.jump)
        start = memory.start * (math.exp(-dt / self.T_start) if self.T_start > 0.0 else 0.0)
        missed = (seen.v_p - memory.command) / self.pid.K_p
        tracking = memory.pid.integral + min(dt / self.T_track, 1.0) * missed
        pull, pid = self.pid.step(filtered, memory.pid._replace(integral=tracking), dt)
        if self.K_ff:
            pull = pull + self.K_ff * curvature / self.plant_gain
        power, heat = self.heater.step(seen, memory.heat, dt, self.v_0, self.heater_range)
        return pull, power, Memory(compensator, filtered, start, pid, pull, heat)


def reference_derivatives(seen: Measured) -> tuple[Floats, Floats]:
    """First [m/s] and second [m/s2] derivative of the reference, from its preview."""
    _, near, far = PREVIEWS
    slope = (seen.r_ref_1min - seen.r_ref) / near
    later = (seen.r_ref_5min - seen.r_ref_1min) / (far - near)
    return slope, (later - slope) / (0.5 * far)
