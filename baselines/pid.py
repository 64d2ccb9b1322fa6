"""PIDs on the bright ring: the paper's controller as printed, and the one made fit for service.

Both have a parallel compensator, a series PID on pull speed and a PI loop on the heater's temperature.

Bukhari, Hovd and Winkler, Part II, equations of the compensator and of K(s), Table 1. Lead and integrator of K are
discretised by Tustin's rule, the compensator by zero-order hold, the temperature loop by forward Euler; every state
starts at zero. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import cont2discrete

from cz_gym.body.process import radius_model
from cz_gym.body.signals import PREVIEWS, Measured
from cz_gym.physics.plant import make_puller
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO

from .policy import Floats, MeasuredController, check_numbers


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


class StandardPID(NamedTuple):
    """The same law as u = gain (1 + 1/(T_i s) + T_d s/(filter_share T_d s + 1)) e, the ISA form of most PLCs."""

    gain: float
    """Gain of the whole law [1/s]."""
    T_i: float
    """Integral time [s]."""
    T_d: float
    """Derivative time [s]."""
    filter_share: float
    """Time constant of the derivative's filter, in shares of T_d [-]."""

    @classmethod
    def of(cls, pid: SeriesPID) -> "StandardPID":
        """The standard form of a series PID, by partial fractions: exact."""
        filter_time = pid.T_d / pid.N
        T_i = pid.T_i + pid.T_d - filter_time
        gain = pid.K_p * T_i / pid.T_i
        T_d = pid.K_p * pid.T_d / gain - filter_time
        return cls(gain, T_i, T_d, filter_time / T_d if T_d else 0.0)

    def series(self) -> SeriesPID:
        """The series form; CzError if it has complex zeros, which no series PID has."""
        filter_time = self.filter_share * self.T_d
        total, product = self.T_i + filter_time, self.T_i * (self.T_d + filter_time)
        if total**2 < 4.0 * product:
            raise CzError("this PID has complex zeros: it has no series form")
        T_i = 0.5 * (total + math.sqrt(total**2 - 4.0 * product))
        T_d = total - T_i
        return SeriesPID(self.gain * T_i / self.T_i, T_i, T_d, T_d / filter_time if filter_time else 100.0)

    def parallel(self) -> tuple[float, float, float]:
        """Gains of the parallel form P + I/s + D s/(filter s + 1): [1/s], [1/s2], [-]."""
        return self.gain, self.gain / self.T_i, self.gain * self.T_d

    @classmethod
    def from_parallel(cls, P: float, I: float, D: float, filter_time: float) -> "StandardPID":
        """The standard form of a parallel one with a derivative filter [s]."""
        return cls(P, P / I, D / P, filter_time * P / D if D else 0.0)


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


class PIDMemory(NamedTuple):
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

    def at_rest(self, seen: Measured) -> PIDMemory:
        """Every state at zero."""
        zero = np.zeros_like(seen.v_p)
        return PIDMemory(np.zeros((len(zero), 2)), PIDState(zero, zero, zero), zero)

    def step(self, seen: Measured, memory: PIDMemory) -> tuple[Floats, Floats, PIDMemory]:
        """Pull speed and heater power above nominal, and the new memory."""
        dt = self.control_interval
        error, compensator = compensated_error(self.compensator, seen, memory.compensator, dt)
        pull, pid = self.pid.step(error, memory.pid, dt)
        temperature_error = seen.T_1_ref - seen.T_1
        power = self.K_T * (temperature_error + memory.heat)
        inside = np.abs(power) <= self.heater_range
        heat = memory.heat + np.where(inside, dt / self.T_iT * temperature_error, 0.0)
        return pull, power, PIDMemory(compensator, pid, heat)


# The heater: a PI loop on the pyrometer, and automatic growth control
#
# Automatic growth control raises the temperature's set-point while the mean pull speed is above nominal. Temperatures
# [K], powers [W], speeds [m/s], all as deviations from the puller's nominal.


class HeaterMemory(NamedTuple):
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

    def at_rest(self, seen: Measured) -> HeaterMemory:
        """The memory before the first sample: the applied power continues."""
        zero = np.zeros_like(seen.T_1)
        return HeaterMemory(seen.Q_H / self.K, np.copy(seen.Q_H), zero, zero)

    def step(
        self, seen: Measured, memory: HeaterMemory, dt: float, v_0: float, heater_range: float
    ) -> tuple[Floats, HeaterMemory]:
        """Power above nominal [W], shape (n,), and the new memory; dt in s, v_0 in m/s, the heater's range in W."""
        mean = memory.mean_pull - math.expm1(-dt / self.T_mean) * (seen.v_p / v_0 - memory.mean_pull)
        before = memory.trim if self.K_pull > 0.0 else 0.0
        trim = np.clip(before + self.K_pull * dt / self.T_pull * mean, -self.limit, self.limit)
        error = self.share * seen.T_1_ref + self.K_pull * mean + trim - seen.T_1
        missed = (seen.Q_H - memory.command) / self.K
        integral = memory.integral + min(dt / self.T_track, 1.0) * missed
        power = self.K * (error + integral)
        integral = integral + dt / self.T_i * error
        return power, HeaterMemory(integral, np.clip(power, -2.0 * heater_range, 2.0 * heater_range), mean, trim)


# Fit for service: measurement filter, anti-windup, bumpless start, trim of the recipe


class FilteredPIDMemory(NamedTuple):
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
    heat: HeaterMemory


@dataclass(frozen=True)
class FilteredPID(MeasuredController):
    """v_p = v_0 + K F e + feed-forward, with e = r_tilde - r_target and F = 1/(1 + T_f s).

    r_target = r_ref + ring_lead d(r_ref)/dt; with ``compensator=None`` it is a conventional PID. The error at the first
    sample is subtracted and returns over T_start, and the integrator starts at the applied pull speed, so that
    switching on moves no drive. It follows the applied pull speed (window, slew rate, drive limits) within T_track.
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

    def at_rest(self, seen: Measured) -> FilteredPIDMemory:
        """The applied pull speed and power continue."""
        zero = np.zeros_like(seen.v_p)
        start = seen.ring_error if self.T_start > 0.0 else zero
        pid = PIDState(zero, zero, seen.v_p / self.pid.K_p)
        return FilteredPIDMemory(np.zeros((len(zero), 2)), zero, start, pid, seen.v_p, self.heater.at_rest(seen))

    def step(self, seen: Measured, memory: FilteredPIDMemory) -> tuple[Floats, Floats, FilteredPIDMemory]:
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
        return pull, power, FilteredPIDMemory(compensator, filtered, start, pid, pull, heat)


def reference_derivatives(seen: Measured) -> tuple[Floats, Floats]:
    """First [m/s] and second [m/s2] derivative of the reference, from its preview."""
    _, near, far = PREVIEWS
    slope = (seen.r_ref_1min - seen.r_ref) / near
    later = (seen.r_ref_5min - seen.r_ref_1min) / (far - near)
    return slope, (later - slope) / (0.5 * far)
