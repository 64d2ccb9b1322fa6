"""The paper's controller: parallel compensator, series PID on pull speed, PI on heater temperature.

Bukhari, Hovd and Winkler, Part II, equations of the compensator and of K(s), Table 1. Lead and integrator of K are
discretised by Tustin's rule, the compensator by zero-order hold, the temperature loop by forward Euler; every state
starts at zero. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import cont2discrete

from cz_gym.baselines.policy import Floats, MeasuredController, check_numbers
from cz_gym.observation import Measured
from cz_gym.support.units import KILO


class PIDState(NamedTuple):
    """The memory of a series PID; each of shape (n,)."""

    lead_in: Floats
    """Input term of the lead [m]."""
    lead_out: Floats
    """Previous output of the lead [m]."""
    integral: Floats
    """Integral of the lead's output, over T_i [m]."""


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

    def __post_init__(self) -> None:
        check_numbers(self, positive=("K_p", "T_i", "N"), not_negative=("T_d",))

    def lead(self, dt: float) -> tuple[float, float, float]:
        """b_0, b_1 and a_1 of the lead y_k = b_0 e_k + b_1 e_(k-1) - a_1 y_(k-1), by Tustin's rule for dt [s]."""
        slow, fast = 2.0 * self.T_d / dt, 2.0 * self.T_d / (self.N * dt)
        return (1.0 + slow) / (1.0 + fast), (1.0 - slow) / (1.0 + fast), (1.0 - fast) / (1.0 + fast)

    def step(self, error: Floats, state: PIDState, dt: float) -> tuple[Floats, PIDState]:
        """Pull speed [m/s] for an error [m], both of shape (n,), and the new state after one sample of dt [s]."""
        b_0, b_1, a_1 = self.lead(dt)
        lead = b_0 * error + state.lead_in
        integral = state.integral + 0.5 * dt / self.T_i * (state.lead_out + lead)
        return self.K_p * (lead + integral), PIDState(b_1 * error - a_1 * lead, lead, integral)


@dataclass(frozen=True)
class Compensator:
    """G_pc(s) = gain s / ((s + fast)(s + slow)) from v_p - v_0 to y_pc, the paper's stable approximation."""

    gain: float = -0.22517
    """Numerator [1/s]."""
    fast: float = 1.684e-3
    """Stable pole of the plant [rad/s]."""
    slow: float = 2.0e-4
    """Cut-off of the high-pass filter [rad/s]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("fast", "slow"))

    @lru_cache(maxsize=16)  # noqa: B019  (frozen settings, few of them)
    def discrete(self, dt: float) -> tuple[Floats, Floats, Floats]:
        """Zero-order hold over dt [s]: A (2, 2), B (2,), C (2,)."""
        A = np.array([[0.0, 1.0], [-self.fast * self.slow, -(self.fast + self.slow)]])
        B, C = np.array([[0.0], [1.0]]), np.array([[0.0, self.gain]])
        A_d, B_d, C_d, _, _ = cont2discrete((A, B, C, np.zeros((1, 1))), dt, method="zoh")
        return A_d, B_d[:, 0], C_d[0]

    def step(self, v_p: Floats, state: Floats, dt: float) -> tuple[Floats, Floats]:
        """y_pc [m], shape (n,), and the new state, shape (n, 2), after v_p - v_0 [m/s] was held for dt [s]."""
        A, B, C = self.discrete(dt)
        moved = state @ A.T + v_p[..., None] * B
        return moved @ C, moved

    def respond(self, v_p: npt.ArrayLike, dt: float) -> Floats:
        """Output y_pc [m] after each step, from rest, for v_p - v_0 [m/s] held for dt [s]; shape (steps, ...)."""
        speeds = np.asarray(v_p, np.float64)
        state = np.zeros((*speeds.shape[1:], 2))
        output = np.empty_like(speeds)
        for k, speed in enumerate(speeds):
            output[k], state = self.step(speed, state, dt)
        return output


def compensated_error(
    compensator: Compensator | None, seen: Measured, state: Floats, dt: float
) -> tuple[Floats, Floats]:
    """r_tilde - r_ref [m], and the compensator's state after the pull speed applied since the last sample."""
    if compensator is None:
        return seen.ring_error, np.zeros_like(state)
    y_pc, state = compensator.step(seen.v_p, state, dt)
    return seen.ring_error + y_pc, state


class Memory(NamedTuple):
    """The memory of :class:`CompensatedPID`."""

    compensator: Floats
    """State of the compensator, shape (n, 2)."""
    pid: PIDState
    heat: Floats
    """Integral of the temperature error, over T_iT [K], shape (n,)."""


@dataclass(frozen=True)
class CompensatedPID(MeasuredController):
    """The paper's controller as printed; with ``compensator=None`` the PID alone, which is unstable.

    v_p = v_0 - K (r_ref - r_tilde), r_tilde = r_br - bias + y_pc, with the compensator driven by the applied pull
    speed; Q_H = Q_H0 + K_T (1 + 1/(T_iT s)) (T_1,ref - T_1), which integrates only while Q_H is inside its range (the
    paper gives no gains for this loop). There is no anti-windup of the pull speed.
    """

    pid: SeriesPID = SeriesPID()
    compensator: Compensator | None = Compensator()
    K_T: float = 1.0 * KILO
    """Gain of the temperature loop [W/K]."""
    T_iT: float = 300.0
    """Integral time of the temperature loop [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, positive=("T_iT",), not_negative=("K_T",))

    def at_rest(self, seen: Measured) -> Memory:
        """Every state at zero."""
        zero = np.zeros_like(seen.v_p)
        return Memory(np.zeros((len(zero), 2)), PIDState(zero, zero, zero), zero)

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        dt = self.control_interval
        error, compensator = compensated_error(self.compensator, seen, memory.compensator, dt)
        pull, pid = self.pid.step(error, memory.pid, dt)
        temperature_error = seen.T_1_ref - seen.T_1
        power = self.K_T * (temperature_error + memory.heat)
        inside = np.abs(power) <= self.heater_range
        heat = memory.heat + np.where(inside, dt / self.T_iT * temperature_error, 0.0)
        return pull, power, Memory(compensator, pid, heat)
