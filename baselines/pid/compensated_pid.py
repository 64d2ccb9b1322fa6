"""The paper's controller: parallel compensator, series PID on pull speed, PI on heater temperature.

Bukhari, Hovd and Winkler, Part II, equations of the compensator and of K(s), Table 1. Lead and integrator of K are
discretised by Tustin, the compensator by zero-order hold, the temperature loop by forward Euler; every state
starts at zero. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import cont2discrete

from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.observation import HEATER_SCALE, PULL_SCALE, decode
from cz_gym.units import KILO


@dataclass(frozen=True)
class SeriesPID:
    """K(s) = K_p (T_i s + 1)(T_d s + 1) / (T_i s (1 + T_d s / N)), Table 1."""

    K_p: float = 0.01
    """Proportional gain [1/s]."""
    T_i: float = 5000.0
    """Integral time [s]."""
    T_d: float = 650.0
    """Derivative time [s]."""
    N: float = 100.0
    """Derivative filter [-]."""

    def lead(self, dt: float) -> tuple[float, float, float]:
        """Tustin's b_0, b_1, a_1 of (T_d s + 1)/(1 + T_d s / N): y = b_0 u + b_1 u_old - a_1 y_old."""
        slow, fast = 2.0 * self.T_d / dt, 2.0 * self.T_d / (self.N * dt)
        return (1.0 + slow) / (1.0 + fast), (1.0 - slow) / (1.0 + fast), (1.0 - fast) / (1.0 + fast)


@dataclass(frozen=True)
class Compensator:
    """G_pc(s) = gain s / ((s + fast)(s + slow)) from v_p - v_0 to y_pc, the paper's stable approximation."""

    gain: float = -0.22517
    """Numerator [1/s]."""
    fast: float = 1.684e-3
    """Plant's stable pole [rad/s]."""
    slow: float = 2.0e-4
    """High-pass cut-off [rad/s]."""

    @lru_cache(maxsize=16)  # noqa: B019  (frozen settings, few of them)
    def discrete(self, dt: float) -> tuple[Floats, Floats, Floats]:
        """Zero-order hold: A (2, 2), B (2,), C (2,)."""
        A = np.array([[0.0, 1.0], [-self.fast * self.slow, -(self.fast + self.slow)]])
        B, C = np.array([[0.0], [1.0]]), np.array([[0.0, self.gain]])
        A_d, B_d, C_d, _, _ = cont2discrete((A, B, C, np.zeros((1, 1))), dt, method="zoh")
        return A_d, B_d[:, 0], C_d[0]

    def respond(self, v_p: npt.ArrayLike, dt: float) -> Floats:
        """Output y_pc [m] from rest, for pull speeds v_p - v_0 [m/s] each held for dt [s].

        ``v_p`` has shape (steps, ...), and so has the result: row k is y_pc at the end of step k.
        """
        speeds = np.asarray(v_p, np.float64)
        A, B, C = self.discrete(dt)
        state = np.zeros((*speeds.shape[1:], 2))
        output = np.empty_like(speeds)
        for k, speed in enumerate(speeds):
            state = state @ A.T + speed[..., None] * B
            output[k] = state @ C
        return output


class Memory(NamedTuple):
    """What the controller remembers, each of shape (n,) or (n, 2)."""

    compensator: Floats
    """State of the compensator."""
    lead_in: Floats
    """Input term of the lead [m]."""
    lead_out: Floats
    """Previous output of the lead [m]."""
    integral: Floats
    """Integral of the lead's output, over T_i [m]."""
    heat: Floats
    """Integral of the temperature error, over T_i [K]."""


@dataclass(frozen=True)
class CompensatedPID:
    """The paper's controller as printed; ``compensator=None`` leaves the PID alone, which is unstable.

    v_p = v_0 - K (r_ref - r_tilde), r_tilde = r_br - bias + y_pc, the compensator driven by the applied pull speed;
    Q_H = Q_H0 + K_T (1 + 1/(T_iT s)) (T_1,ref - T_1), integrating only while Q_H is inside its range (the paper gives
    no gains for this loop). While the camera is invalid, the observation holds the last reading. No anti-windup.
    """

    control_interval: float = 5.0
    """Time between actions [s]."""
    pid: SeriesPID = SeriesPID()
    compensator: Compensator | None = Compensator()
    K_T: float = 1.0 * KILO
    """Gain of the temperature loop [W/K]."""
    T_iT: float = 300.0
    """Its integral time [s]."""
    v_0: float = PULL_SCALE
    """Nominal pull speed of the environment's parameters [m/s]."""

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """Act on "measured" (or "history") observations."""
        array, single = batched(observation)
        seen = decode(array, self.v_0)
        n = len(array)
        at_rest = Memory(np.zeros((n, 2)), *(np.zeros(n) for _ in range(4)))
        memory = fresh(state, at_rest, episode_start)
        error, compensator = self._compensate(seen, memory)
        lead, lead_in = self._lead(error, memory)
        dt = self.control_interval
        integral = memory.integral + 0.5 * dt / self.pid.T_i * (memory.lead_out + lead)
        pull = self.pid.K_p * (lead + integral) / self.v_0
        power, heat = self._temperature(seen, memory)
        action = to_action(pull, power / HEATER_SCALE, single)
        return action, Memory(compensator, lead_in, lead, integral, heat)

    def _compensate(self, seen: Any, memory: Memory) -> tuple[Floats, Floats]:
        """r_tilde - r_ref [m] and the compensator's state, moved on by the pull speed applied since."""
        if self.compensator is None:
            return seen.ring_error, memory.compensator
        A, B, C = self.compensator.discrete(self.control_interval)
        moved = memory.compensator @ A.T + seen.v_p[:, None] * B
        return seen.ring_error + moved @ C, moved

    def _lead(self, error: Floats, memory: Memory) -> tuple[Floats, Floats]:
        b_0, b_1, a_1 = self.pid.lead(self.control_interval)
        return b_0 * error + memory.lead_in, b_1 * error - a_1 * (b_0 * error + memory.lead_in)

    def _temperature(self, seen: Any, memory: Memory) -> tuple[Floats, Floats]:
        """Power above nominal [W] and the new integral."""
        error = seen.T_1_ref - seen.T_1
        power = self.K_T * (error + memory.heat)
        inside = np.abs(power) <= HEATER_SCALE
        heat = memory.heat + np.where(inside, self.control_interval / self.T_iT * error, 0.0)
        return power, heat
