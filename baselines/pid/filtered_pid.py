"""The paper's controller made fit for service: measurement filter, anti-windup, bumpless start, trim of the recipe.

The same structure as :mod:`cz_gym.baselines.pid.compensated_pid` and the same discretisation where they overlap
(compensator by zero-order hold on the applied pull speed, lead and integrator by Tustin). With ``compensator=None`` it
is the PID of a plant without compensator. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from cz_gym.baselines.policy import Floats, MeasuredController
from cz_gym.observation import PULL_SCALE, Measured
from cz_gym.units import MINUTE

from .compensated_pid import Compensator, PIDState, SeriesPID, compensated_error
from .temperature_loop import Heat, TemperatureLoop


class Memory(NamedTuple):
    """What the controller remembers, each of shape (n,) but the compensator's state, (n, 2)."""

    compensator: Floats
    """State of the compensator."""
    filtered: Floats
    """Filtered radius error [m]."""
    start: Floats
    """What is left of the error found at the start [m]."""
    pid: PIDState
    command: Floats
    """Pull speed above nominal asked for last [m/s]."""
    heat: Heat


@dataclass(frozen=True)
class FilteredPID(MeasuredController):
    """v_p = v_0 + K F e + feed-forward, e = r_tilde - r_target, F = 1/(1 + T_f s).

    r_target = r_ref + ring_lead d(r_ref)/dt. A reading further than ``jump`` from the filter counts as that far. The
    error found at the start is subtracted and comes back over T_start, and the integrator starts at the pull speed
    applied, so that switching on moves nothing. The integrator follows the pull speed really applied (window, slew
    rate, drive limits) within T_track. While the camera is invalid the observation repeats the last reading: hold.
    """

    control_interval: float = 5.0
    """Time between actions [s]."""
    pid: SeriesPID = field(default_factory=SeriesPID)
    compensator: Compensator | None = field(default_factory=Compensator)
    T_f: float = 20.0
    """Measurement filter [s]; 0 is none."""
    jump: float = math.inf
    """Largest difference between reading and filter that counts [m]."""
    T_start: float = 0.0
    """Time constant in which the error found at the start is taken up [s]; 0 takes it up at once."""
    T_track: float = 600.0
    """Time in which the integrator follows a limited drive [s]."""
    ring_lead: float = 0.0
    """Lead of the ring's target on a moving reference [s]; G_m's own lead coefficient is -46 s."""
    K_ff: float = 0.0
    """Feed-forward of the reference's acceleration, in multiples of the inverse plant [-]."""
    heater: TemperatureLoop = field(default_factory=TemperatureLoop)
    v_0: float = PULL_SCALE
    """Nominal pull speed of the environment's parameters [m/s]."""

    def at_rest(self, seen: Measured) -> Memory:
        """The pull speed and the power applied now go on."""
        zero = np.zeros_like(seen.v_p)
        start = seen.ring_error if self.T_start > 0.0 else zero
        pid = PIDState(zero, zero, seen.v_p / self.pid.K_p)
        return Memory(np.zeros((len(zero), 2)), zero, start, pid, seen.v_p, self.heater.at_rest(seen))

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        dt = self.control_interval
        slope, curvature = reference_derivatives(seen)
        error, compensator = compensated_error(self.compensator, seen, memory.compensator, dt)
        filtered = self._filter(error - self.ring_lead * slope - memory.start, memory.filtered)
        start = memory.start * (math.exp(-dt / self.T_start) if self.T_start > 0.0 else 0.0)
        missed = (seen.v_p - memory.command) / self.pid.K_p
        tracking = memory.pid.integral + min(dt / self.T_track, 1.0) * missed
        pull, pid = self.pid.step(filtered, memory.pid._replace(integral=tracking), dt)
        pull = pull + self.K_ff * curvature / INVERSE_GAIN
        power, heat = self.heater.step(seen, memory.heat, dt, self.v_0)
        return pull, power, Memory(compensator, filtered, start, pid, pull, heat)

    def _filter(self, error: Floats, filtered: Floats) -> Floats:
        """First-order low-pass, exact for a held input, its input held within ``jump`` of its output."""
        pace = -math.expm1(-self.control_interval / self.T_f) if self.T_f > 0.0 else 1.0
        return filtered + pace * np.clip(error - filtered, -self.jump, self.jump)


INVERSE_GAIN = -4.888e-3
"""Numerator of G_p [1/s] (:mod:`cz_gym.physics.linearisation`): r'' = INVERSE_GAIN (v_p - v_0) on Model II."""
_NEAR, _FAR = 1.0 * MINUTE, 5.0 * MINUTE


def reference_derivatives(seen: Measured) -> tuple[Floats, Floats]:
    """First [m/s] and second [m/s2] derivative of the reference, from its preview."""
    near = (seen.r_ref_1min - seen.r_ref) / _NEAR
    far = (seen.r_ref_5min - seen.r_ref_1min) / (_FAR - _NEAR)
    return near, (far - near) / (0.5 * _FAR)
