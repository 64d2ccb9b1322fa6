"""Filter whose prediction errors are made small: an extended Kalman filter on the plant, and its derivatives.

Twelve states: the plant's five, a fast and a slow fluctuation of the interface temperature [K], a heat load on the melt
[W] with its rate [W/s], the constant offsets of pyrometer [K] and ring [m], and T_1 behind the pyrometer's filter [K].
The heater's lag and dead time act on the log's power before it reaches the filter. The mean moves by the plant's
equations, the covariance by the plant linearised at its operating point. The loop takes complex numbers: a complex step
through it gives the derivatives of every prediction error, and of its variance, by a parameter.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.signal import lfilter

from cz_gym.episodes.scenario import MIX
from cz_gym.jit import hashed, kernel
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, Disturbance, State, derive_puller, rates, rk4
from cz_gym.process import Inputs
from cz_gym.support.units import MM

from .log import Floats, Log

Numbers = npt.NDArray[np.complex128]
STATES = (*State._fields, "fast", "slow", "load", "load_rate", "pyrometer_offset", "ring_offset", "shown")
FAST, SLOW, LOAD, RATE, PYROMETER, RING, SHOWN = range(5, len(STATES))
LONGEST_STEP = 5.0
"""Longest step of the integration [s]."""
QUICKEST = 1e-6
"""Time constant of a pyrometer without a filter [s]."""
_STEP, _SHARE = 1e-30, 1e-6


class NoiseLevels(NamedTuple):
    """Strength of the disturbances and of the sensors' noise."""

    camera_sd: Any = 0.025 * MM
    """Standard deviation of the ring's noise [m]."""
    pyrometer_sd: Any = 0.1
    """Standard deviation of the pyrometer's noise [K]."""
    fast_sd: Any = 0.25
    """Fluctuation of the interface temperature with a correlation time of TAU_FAST [K]."""
    slow_sd: Any = 0.25
    """Fluctuation of the interface temperature with a correlation time of TAU_SLOW [K]."""
    load_rate: Any = 1e-5
    """Rate of the heat load on the melt, in shares of the heat that passes through it [1/s]."""


class Lags(NamedTuple):
    """Delays of the heater's path."""

    heater_lag: Any = 0.0
    """Time constant with which the power that heats follows the log's [s]."""
    heater_dead_time: Any = 0.0
    """Dead time of the power that heats [s]; negative where the log's row holds the power that comes after it."""
    pyrometer_filter: Any = 0.0
    """Time constant of the pyrometer's filter [s]."""


RING_GAIN = "ring_gain"
"""Factor on the ring-to-height gain; a free number only where a log is judged."""
LAM = MIX
"""Share of conduction where it is not free, and the mean of its prior [-]."""
TAU_FAST, TAU_SLOW, TAU_RATE = 30.0, 780.0, 2400.0
"""Correlation times of the interface temperature's fluctuations and of the load's rate [s]."""
START_SD = (0.5 * MM, 0.1 * MM, 1.0, 0.5, 0.3)
"""Standard deviation of the plant's state at the log's first row; pyrometer and ring have offsets of their own."""
OFFSET_SD = 5.0, 1.0 * MM
"""Standard deviation of the pyrometer's offset [K] and the ring's [m]."""
DRIFT_SD = 5.0
"""Standard deviation of the hot zone's drift at the first row: heater and susceptor are warmer, and a load on the melt
takes the heat away [K]."""
FLOOR = 0.01, 3e-3 * MM
"""Least noise of pyrometer [K] and ring [m]: no sensor is better."""


class Predicted(NamedTuple):
    """Prediction errors of pyrometer [K] and ring [m], shape (rows, 2); 0 with variance 1 where nothing was read."""

    error: Any
    variance: Any
    state: Any
    """Estimated states after each row, shape (rows, 12)."""
    before: Any
    """States that were expected before each row."""
    covariance: Any
    """Covariance of the estimates, shape (rows, 12, 12)."""


@lru_cache(maxsize=4)
def build_filter(meniscus: MeniscusModel) -> Any:
    """Compile the filter's loop for a meniscus model."""
    slope, ring_offset = meniscus.slope, meniscus.ring_offset

    def run(
        p: Any, A: Any, Q: Any, z: Any, start: Any, R: Any, read: Any, drives: Any, unsure: Any, gap: Any, slow: Any,
        gain: Any, dt: Any, parts: Any, lowest: Any, highest: Any, error: Any, variance: Any, states: Any,
        expected: Any, covariance: Any,
    ) -> None:  # fmt: skip
        P, A_t = start, np.ascontiguousarray(A.T)
        for k in range(read.shape[0]):
            if k > 0:
                x, u = State(z[0], z[1], z[2], z[3], z[4]), Inputs(drives[k, 0] + 0.0 * z[0], drives[k, 1] + 0.0 * z[0])
                d = Disturbance(z[7], z[5] + z[6], 1.0 + 0.0 * z[0])
                for _ in range(parts):
                    x = rk4(x, u, d, p, dt / parts, slope)
                lag = slow * (x.T_1 - z[2]) / dt
                shown = x.T_1 - lag + (z[11] - z[2] + lag) * np.exp(-dt / slow)
                z = A @ z
                z[0], z[1], z[2], z[3], z[4], z[11] = x.r_c, x.h_c, x.T_1, x.T_2, x.T_b, shown
                P = start.copy() if gap[k] else A @ P @ A_t + Q
                P[1, 1] += (dt * unsure[k, 0]) ** 2
                P[2, 2] += (dt * unsure[k, 1] / p.C_1) ** 2
            expected[k] = z
            for sensor in range(2):
                error[k, sensor], variance[k, sensor] = 0.0, 1.0
                if np.isnan(read[k, sensor]):
                    continue
                H = np.zeros_like(z)
                if sensor == 0:
                    H[11], H[9], reads = 1.0, 1.0, z[11] + z[9]
                else:
                    near, far = _SHARE * z[0], _SHARE * z[1]
                    wider = ring_offset(z[0] + near, z[1], p) - ring_offset(z[0] - near, z[1], p)
                    higher = ring_offset(z[0], z[1] + far, p) - ring_offset(z[0], z[1] - far, p)
                    H[0], H[1], H[10] = 1.0 + gain * wider / (2.0 * near), gain * higher / (2.0 * far), 1.0
                    reads = z[0] + p.ring_bias + gain * (ring_offset(z[0], z[1], p) - p.ring_bias) + z[10]
                PH = P @ H
                error[k, sensor], variance[k, sensor] = read[k, sensor] - reads, (H * PH).sum() + R[sensor]
                z = z + PH * (error[k, sensor] / variance[k, sensor])
                P = P - np.outer(PH, PH / variance[k, sensor])
            if not lowest < z[1].real < highest:
                z[1] = min(max(z[1].real, lowest), highest)
            states[k], covariance[k] = z, P

    return kernel(run, keep=hashed(*meniscus.functions))


class Model(NamedTuple):
    """Map from free numbers to a puller, its lags and its noise.

    Free numbers are logarithms of factors on the start's numbers, but ``lam`` and the heater's dead time themselves.
    """

    names: tuple[str, ...]
    """Names of the free numbers, of Parameters, Lags, NoiseLevels and ``lam``."""
    start: Parameters
    meniscus: MeniscusModel = HURLE
    lags: Lags = Lags()
    """Lags of the start, which the factors refer to."""

    @property
    def mean(self) -> Any:
        """Free numbers of the start, shape (names,)."""
        plain = {"lam": LAM, "heater_dead_time": self.lags.heater_dead_time}
        return np.array([plain.get(name, 0.0) for name in self.names])

    def value(self, name: str, at: float) -> float:
        """Value of the number of that name where its free number is ``at``; of ``lam``, the product lam dT_0 [K]."""
        if name in ("lam", "heater_dead_time"):
            return at * self.start.dT_0 if name == "lam" else at
        start = next(part for part in (NoiseLevels(), self.lags, self.start) if name in part._fields)
        return float(getattr(start, name) * np.exp(at))

    def delays(self, theta: Any) -> Lags:
        """Lags at the free numbers ``theta``, real or complex, shape (names,)."""
        free = dict(zip(self.names, theta, strict=True))
        lag, dead_time, slow = self.lags
        lag, slow = lag * np.exp(free.get("heater_lag", 0.0)), slow * np.exp(free.get("pyrometer_filter", 0.0))
        return Lags(lag, free.get("heater_dead_time", dead_time), slow)

    def puller(self, theta: Any) -> Any:
        """Puller at the free numbers ``theta``, as :meth:`delays`."""
        free = dict(zip(self.names, theta, strict=True))
        factors = {name: np.exp(value) for name, value in free.items() if name in Parameters._fields}
        q = self.start._replace(**{name: getattr(self.start, name) * factor for name, factor in factors.items()})
        zero = 0.0 * theta[0]
        numbers = Parameters(*(number + zero for number in q))
        return derive_puller(numbers, free.get("lam", LAM) + zero, self.meniscus.height, self.meniscus.ring_offset)

    def noises(self, theta: Any) -> NoiseLevels:
        """Noise at the free numbers ``theta``, as :meth:`delays`."""
        free = dict(zip(self.names, theta, strict=True))
        return NoiseLevels(*(usual * np.exp(free.get(name, 0.0)) for name, usual in NoiseLevels()._asdict().items()))


def predict(log: Log, model: Model, theta: Any) -> Predicted:
    """Run the filter of the free numbers ``theta``, shape (names,), real or complex, over a log."""
    p, noise, meniscus = model.puller(np.asarray(theta, np.complex128)), model.noises(theta), model.meniscus
    through, delays = p.Q_H_0 - p.G_1a * (p.T_1_0 - p.T_a), model.delays(theta)
    slow = np.complex128(delays.pyrometer_filter + QUICKEST)
    A, Q = _sampled(p, noise, slow, log.interval, meniscus)
    z, P = np.zeros(len(STATES), np.complex128), np.zeros((len(STATES),) * 2, np.complex128)
    z[:5] = p.state_0
    known = np.isfinite(log.r_ref).all()
    z[0] = log.r_ref[0] if known else p.r_0
    z[RING] = np.nanmedian(log.ring - (log.r_ref if known else p.r_0.real)) - p.ring_bias
    start_sd = {FAST: noise.fast_sd, SLOW: noise.slow_sd, RATE: noise.load_rate * through}
    for state, sd in (*enumerate(START_SD), *start_sd.items(), (PYROMETER, OFFSET_SD[0]), (RING, OFFSET_SD[1])):
        P[state, state] = sd**2
    warmer = _susceptor_per_heater(p)
    drift = DRIFT_SD * np.array([0.0, 0.0, 1.0, warmer, 0.0, 0.0, 0.0, -p.G_2b * warmer, *[0.0] * 4])
    P = P + np.outer(drift, drift)
    z[SHOWN], P[SHOWN], P[:, SHOWN] = z[2], P[2], P[:, 2]
    P[SHOWN, SHOWN] = P[2, 2]
    rows, parts, n = len(log.time), math.ceil(log.interval / LONGEST_STEP - 1e-9), len(STATES)
    out = Predicted(*(np.zeros((rows, *shape), np.complex128) for shape in ((2,), (2,), (n,), (n,), (n, n))))
    R = np.array([noise.pyrometer_sd**2, noise.camera_sd**2], np.complex128) / log.mean_of + np.square(FLOOR)
    read, drives = np.stack([log.T_1, log.ring], axis=1), np.stack([log.v_p, heating(log, delays)], axis=1)
    limits = HEIGHT_MIN, HEIGHT_MAX_IN_A * float(p.a.real)
    gain = np.complex128(np.exp(dict(zip(model.names, theta, strict=True)).get(RING_GAIN, 0.0)))
    steps = log.unsure, log.gap, slow, gain, log.interval, parts
    build_filter(meniscus)(p, A, Q, z, P, R, read, drives, *steps, *limits, *out)
    return out


def heating(log: Log, delays: Lags) -> Numbers:
    """Mean power that reaches the heater's mass in the interval before each row [W], shape (rows,)."""
    late, n, dt = delays.heater_dead_time / log.interval, len(log.Q_H), log.interval
    whole = math.floor(late.real)
    first, second = (log.Q_H[np.clip(np.arange(n) - whole - k, 0, n - 1)] for k in (0, 1))
    arrives: Numbers = (first + (late - whole) * (second - first)).astype(np.complex128)
    if not delays.heater_lag.real:
        return arrives
    keep = np.exp(-dt / delays.heater_lag)
    begins = np.array([keep * arrives[0]])
    follows, _ = lfilter([1.0 - keep], [1.0, -keep], arrives, zi=begins)
    before = np.concatenate([arrives[:1], follows[:-1]])
    heats: Numbers = arrives + (before - arrives) * (1.0 - keep) * delays.heater_lag / dt
    return heats


def _sampled(p: Any, noise: NoiseLevels, slow: Any, dt: float, meniscus: MeniscusModel) -> tuple[Numbers, Numbers]:
    """Transition over dt [s] at the operating point, and the covariance of the disturbances in it (Van Loan 1978)."""
    n, through = len(STATES), p.Q_H_0 - p.G_1a * (p.T_1_0 - p.T_a)
    F, Q = np.zeros((n, n), np.complex128), np.zeros((n, n), np.complex128)
    point = np.array([*p.state_0, 0.0, 0.0], np.complex128)
    size = np.array([*p.state_0, p.Q_H_0, 1.0])

    def motion(at: Any) -> Numbers:
        d = Disturbance(at[5], at[6], 1.0)
        return np.array(rates(State(*at[:5]), p.inputs_0, d, p, meniscus.slope))

    for j, shift in enumerate(_SHARE * size * np.eye(7)):
        column = (motion(point + shift) - motion(point - shift)) / (2.0 * shift[j])
        for state in ((j,), (LOAD,), (FAST, SLOW))[max(j - 4, 0)]:
            F[:5, state] = column
    F[LOAD, RATE], F[SHOWN, 2], F[SHOWN, SHOWN] = 1.0, 1.0 / slow, -1.0 / slow
    A = expm(F * dt)
    for state, sd, tau in (
        (FAST, noise.fast_sd, TAU_FAST),
        (SLOW, noise.slow_sd, TAU_SLOW),
        (RATE, noise.load_rate * through, TAU_RATE),
    ):
        A[state, state] = np.exp(-dt / tau)
        Q[state, state] = sd**2 * (1.0 - A[state, state] ** 2)
    return A, Q


def sensitivities(log: Log, model: Model, theta: Floats) -> tuple[Predicted, Floats, Floats]:
    """Run the filter at ``theta``, with the derivatives of errors and variances, each of shape (names, rows, 2)."""
    runs = [predict(log, model, theta + 1j * _STEP * unit) for unit in np.eye(len(theta))]
    errors, variances = (np.stack([run[part].imag for run in runs]) / _STEP for part in (0, 1))
    return Predicted(*(np.ascontiguousarray(part.real) for part in runs[0])), errors, variances


def smooth(log: Log, model: Model, theta: Floats) -> Floats:
    """States at each row given the whole log, shape (rows, 12), by the smoother of Rauch, Tung and Striebel (1965).

    It begins anew, as the filter does, at a long gap.
    """
    out = Predicted(*(part.real for part in predict(log, model, theta)))
    slow = np.complex128(model.delays(theta).pyrometer_filter + QUICKEST)
    p, noise = model.puller(np.asarray(theta, np.complex128)), model.noises(theta)
    A, Q = (part.real for part in _sampled(p, noise, slow, log.interval, model.meniscus))
    states: Floats = out.state.copy()
    for k in reversed(range(len(states) - 1)):
        if log.gap[k + 1]:
            continue
        ahead = A @ out.covariance[k] @ A.T + Q
        ahead[[1, 2], [1, 2]] += (log.interval * log.unsure[k + 1] / (1.0, p.C_1.real)) ** 2
        sd = np.sqrt(np.diag(ahead))
        inverse = np.linalg.pinv(ahead / np.outer(sd, sd), hermitian=True) / np.outer(sd, sd)
        states[k] += out.covariance[k] @ A.T @ inverse @ (states[k + 1] - out.before[k + 1])
    return states


def melt_from_start(log: Log, model: Model, theta: Floats, start: Floats) -> Floats:
    """Deviation of T_b [K] at each row, shape (rows,), that is left of temperatures not at rest in the state ``start``.

    At rest, the susceptor is warmer by what the load takes away, and the heater with it.
    """
    p, thermal = model.puller(np.asarray(theta, np.complex128)), slice(2, 5)
    A = _sampled(p, model.noises(theta), np.complex128(QUICKEST), log.interval, model.meniscus)[0].real
    susceptor = -start[LOAD] / p.G_2b.real
    rest = np.array([susceptor / _susceptor_per_heater(p).real, susceptor, 0.0])
    deviation, melt = start[thermal] - np.real(p.state_0[thermal]) - rest, np.empty(len(log.time))
    for k in range(len(melt)):
        melt[k], deviation = deviation[2], A[thermal, thermal] @ deviation
    return melt


def _susceptor_per_heater(p: Any) -> Any:
    """Rise of T_2 per rise of T_1 at a constant T_b [K/K]."""
    return p.T_1_0**3 / (p.T_2_0**3 + p.G_2b / (4.0 * p.kappa_12))
