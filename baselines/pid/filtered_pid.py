"""The paper's controller made fit for service: measurement filter, anti-windup, bumpless start, trim of the recipe.

The same structure as :mod:`cz_gym.baselines.pid.compensated_pid` and the same discretisation where they overlap
(compensator by zero-order hold on the applied pull speed, lead and integrator by Tustin). With ``compensator=None`` it
is the PID of a plant without compensator. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.observation import HEATER_SCALE, PULL_SCALE, decode
from cz_gym.units import MINUTE

from .compensated_pid import Compensator, SeriesPID
from .temperature_loop import Heat, TemperatureLoop


class Memory(NamedTuple):
    """What the controller remembers, each of shape (n,) or (n, 2)."""

    compensator: Floats
    """State of the compensator."""
    filtered: Floats
    """Filtered radius error [m]."""
    start: Floats
    """What is left of the error found at the start [m]."""
    lead_in: Floats
    """Input term of the lead [m]."""
    lead_out: Floats
    """Previous output of the lead [m]."""
    integral: Floats
    """Integral of the lead's output, over T_i [m]."""
    command: Floats
    """Pull speed above nominal asked for last [m/s]."""
    heat_integral: Floats
    heat_command: Floats
    mean_pull: Floats
    trim: Floats

    @property
    def heat(self) -> Heat:
        """The temperature loop's part."""
        return Heat(*self[-len(Heat._fields) :])


@dataclass(frozen=True)
class FilteredPID:
    """v_p = v_0 + K F e + feed-forward, e = r_tilde - r_target, F = 1/(1 + T_f s).

    r_target = r_ref + ring_lead d(r_ref)/dt. A reading further than ``jump`` from the filter counts as that far. At the
    start the error found is taken for zero and given back over T_start, and the integrator takes up the pull speed
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
    """Largest difference between reading and filter that is believed [m]."""
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

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """Act on "measured" (or "history") observations."""
        array, single = batched(observation)
        seen = decode(array, self.v_0)
        memory = fresh(state, self._at_rest(seen), episode_start)
        dt = self.control_interval
        slope, curvature = _ahead(seen)
        compensated, compensator = self._compensate(seen, memory)
        filtered = self._filter(compensated - self.ring_lead * slope - memory.start, memory.filtered)
        start = memory.start * (math.exp(-dt / self.T_start) if self.T_start > 0.0 else 0.0)
        b_0, b_1, a_1 = self.pid.lead(dt)
        lead = b_0 * filtered + memory.lead_in
        missed = (seen.v_p - memory.command) / self.pid.K_p
        integral = memory.integral + min(dt / self.T_track, 1.0) * missed
        integral = integral + 0.5 * dt / self.pid.T_i * (memory.lead_out + lead)
        pull = self.pid.K_p * (lead + integral) + self.K_ff * curvature / INVERSE_GAIN
        power, heat = self.heater.step(seen, memory.heat, dt, self.v_0)
        action = to_action(pull / self.v_0, power / HEATER_SCALE, single)
        lead_in = b_1 * filtered - a_1 * lead
        return action, Memory(compensator, filtered, start, lead_in, lead, integral, pull, *heat)

    def _at_rest(self, seen: Any) -> Memory:
        zero = np.zeros_like(seen.v_p)
        start = seen.ring_error if self.T_start > 0.0 else zero
        integral = seen.v_p / self.pid.K_p
        return Memory(np.zeros((len(zero), 2)), zero, start, zero, zero, integral, seen.v_p, *self.heater.at_rest(seen))

    def _compensate(self, seen: Any, memory: Memory) -> tuple[Floats, Floats]:
        """r_tilde - r_ref [m] and the compensator's state, moved on by the pull speed applied since."""
        if self.compensator is None:
            return seen.ring_error, np.zeros_like(memory.compensator)
        A, B, C = self.compensator.discrete(self.control_interval)
        moved = memory.compensator @ A.T + seen.v_p[:, None] * B
        return seen.ring_error + moved @ C, moved

    def _filter(self, error: Floats, filtered: Floats) -> Floats:
        """First-order low-pass, exact for a held input, its input held within ``jump`` of its output."""
        pace = -math.expm1(-self.control_interval / self.T_f) if self.T_f > 0.0 else 1.0
        return filtered + pace * np.clip(error - filtered, -self.jump, self.jump)


INVERSE_GAIN = -4.888e-3
"""Numerator of G_p [1/s] (:mod:`cz_gym.physics.linearisation`): r'' = INVERSE_GAIN (v_p - v_0) on Model II."""
_NEAR, _FAR = 1.0 * MINUTE, 5.0 * MINUTE


def _ahead(seen: Any) -> tuple[Floats, Floats]:
    """First [m/s] and second [m/s2] derivative of the reference, from its preview."""
    near = (seen.r_ref_1min - seen.r_ref) / _NEAR
    far = (seen.r_ref_5min - seen.r_ref_1min) / (_FAR - _NEAR)
    return near, (far - near) / (0.5 * _FAR)
