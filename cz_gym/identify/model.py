"""The filter whose prediction errors are made small: an extended Kalman filter on the plant, and its derivatives.

Eleven states: the plant's five, a fast and a slow fluctuation of the interface temperature [K], a heat load on the melt
[W] with its rate [W/s], and the constant offsets of pyrometer [K] and ring [m]. The mean moves by the plant's
equations, the covariance by the plant linearised at its operating point. The loop takes complex numbers, so a complex step through
it gives the derivatives of every prediction error, and of its variance, by a parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from cz_gym.jit.cache import hashed
from cz_gym.jit.compile import kernel
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Disturbance, Inputs, State, derive_puller, rates, rk4
from cz_gym.task import HEIGHT_MAX_IN_A, HEIGHT_MIN
from cz_gym.units import MM

from .log import Log

Numbers = npt.NDArray[np.complex128]
STATES = (*State._fields, "fast", "slow", "load", "load_rate", "pyrometer_offset", "ring_offset")
FAST, SLOW, LOAD, RATE, PYROMETER, RING = range(5, len(STATES))
LONGEST_STEP = 5.0
"""Longest step of the integration [s]."""
_STEP, _SHARE = 1e-30, 1e-6


class Noise(NamedTuple):
    """Strength of the disturbances and of the sensors' noise."""

    camera_sd: Any = 0.025 * MM
    """[m]"""
    pyrometer_sd: Any = 0.1
    """[K]"""
    fast_sd: Any = 0.25
    """Fluctuation of the interface temperature with a correlation time of 30 s [K]."""
    slow_sd: Any = 0.25
    """The one of 780 s [K]."""
    load_rate: Any = 1e-5
    """Rate of the heat load on the melt, in shares of the heat that passes through it [1/s]."""


TAU_FAST, TAU_SLOW, TAU_RATE = 30.0, 780.0, 2400.0
"""Correlation times of the interface temperature's fluctuations and of the load's rate [s]."""
START_SD = (0.5 * MM, 0.2 * MM, 5.0, 5.0, 2.0)
"""Standard deviation of the plant's state at the log's first row; pyrometer and ring have offsets of their own."""
OFFSET_SD = 5.0, 1.0 * MM
"""Standard deviation of the pyrometer's offset [K] and the ring's [m]."""
LOAD_SD = 0.05
"""Standard deviation of the heat load at the first row, in shares of the heat through the melt [-]."""


FLOOR = 0.01, 3e-3 * MM
"""Least noise of pyrometer [K] and ring [m]: no sensor is better."""


class Predicted(NamedTuple):
    """Prediction errors of pyrometer [K] and ring [m], shape (rows, 2); 0 with variance 1 where nothing was read."""

    error: Numbers
    variance: Numbers
    state: Numbers
    """Estimated states after each row, shape (rows, 11)."""


@lru_cache(maxsize=4)
def build_filter(meniscus: MeniscusModel) -> Any:
    """Compile the filter's loop for a meniscus model."""
    slope, ring_offset = meniscus.slope, meniscus.ring_offset

    def run(
        p: Any, A: Any, Q: Any, z: Any, start: Any, R: Any, read: Any, drives: Any, gap: Any, dt: Any, parts: Any,
        lowest: Any, highest: Any, error: Any, variance: Any, states: Any,
    ) -> None:  # fmt: skip
        n, P, AP, H = z.size, start.copy(), np.zeros_like(A), np.zeros_like(z)
        for k in range(read.shape[0]):
            if k > 0:
                x, u = State(z[0], z[1], z[2], z[3], z[4]), Inputs(drives[k, 0] + 0.0 * z[0], drives[k, 1] + 0.0 * z[0])
                d = Disturbance(z[7], z[5] + z[6], 1.0 + 0.0 * z[0])
                for _ in range(parts):
                    x = rk4(x, u, d, p, dt / parts, slope)
                z[0], z[1], z[2], z[3], z[4] = x.r_c, x.h_c, x.T_1, x.T_2, x.T_b
                z[5], z[6], z[7], z[8] = A[5, 5] * z[5], A[6, 6] * z[6], z[7] + A[7, 8] * z[8], A[8, 8] * z[8]
                for i in range(n):
                    for j in range(n):
                        AP[i, j] = 0.0
                    for m in range(n):
                        if A[i, m] != 0.0:
                            for j in range(n):
                                AP[i, j] += A[i, m] * P[m, j]
                for i in range(n):
                    for j in range(i, n):
                        total = Q[i, j]
                        for m in range(n):
                            total += AP[i, m] * A[j, m]
                        P[i, j], P[j, i] = total, total
            if gap[k]:
                P[:, :] = start
            for sensor in range(2):
                error[k, sensor], variance[k, sensor] = 0.0, 1.0
                if np.isnan(read[k, sensor]):
                    continue
                H[:] = 0.0
                if sensor == 0:
                    H[2], H[9], expected = 1.0, 1.0, z[2] + z[9]
                else:
                    near, far = 1e-6 * z[0], 1e-6 * z[1]
                    H[0] = 1.0 + (ring_offset(z[0] + near, z[1], p) - ring_offset(z[0] - near, z[1], p)) / (2.0 * near)
                    H[1] = (ring_offset(z[0], z[1] + far, p) - ring_offset(z[0], z[1] - far, p)) / (2.0 * far)
                    H[10], expected = 1.0, z[0] + ring_offset(z[0], z[1], p) + z[10]
                PH = AP[0]
                S = R[sensor]
                for i in range(n):
                    PH[i] = 0.0
                    for j in range(n):
                        PH[i] += P[i, j] * H[j]
                for i in range(n):
                    S += H[i] * PH[i]
                e = read[k, sensor] - expected
                error[k, sensor], variance[k, sensor] = e, S
                for i in range(n):
                    z[i] += PH[i] / S * e
                    for j in range(n):
                        P[i, j] -= PH[i] * PH[j] / S
            if z[1].real < lowest:
                z[1] = lowest
            if z[1].real > highest:
                z[1] = highest
            for i in range(n):
                states[k, i] = z[i]

    return kernel(run, keep=hashed(*meniscus.functions))


def predict(log: Log, q: Any, lam: Any, noise: Noise, meniscus: MeniscusModel = HURLE) -> Predicted:
    """Run the filter over a log; ``q`` are parameters, ``lam`` the share of conduction, all real or complex."""
    p = derive_puller(type(q)(*map(complex, q)), complex(lam), meniscus.height, meniscus.ring_offset)
    through = p.Q_H_0 - p.G_1a * (p.T_1_0 - p.T_a)
    A, Q = _sampled(p, noise, through, log.interval, meniscus)
    z, P = np.zeros(len(STATES), np.complex128), np.zeros((len(STATES),) * 2, np.complex128)
    z[:5] = p.state_0
    z[0] = log.r_ref[0] if np.isfinite(log.r_ref[0]) else p.r_0
    z[RING] = np.nanmedian(log.ring - log.r_ref if np.isfinite(log.r_ref).all() else log.ring - p.r_0.real) - p.ring_bias
    P[range(5), range(5)] = np.square(START_SD)
    P[[FAST, SLOW, LOAD], [FAST, SLOW, LOAD]] = noise.fast_sd**2, noise.slow_sd**2, (LOAD_SD * through) ** 2
    P[RATE,RATE]=(noise.load_rate*through)**2
    P[[PYROMETER, RING], [PYROMETER, RING]] = np.square(OFFSET_SD)
    rows, parts = len(log.time), int(np.ceil(log.interval / LONGEST_STEP - 1e-9))
    out = Predicted(*(np.zeros((rows, width), np.complex128) for width in (2, 2, len(STATES))))
    R = np.array([noise.pyrometer_sd**2, noise.camera_sd**2], np.complex128) + np.square(FLOOR)
    read, drives = np.stack([log.T_1, log.ring], axis=1), np.stack([log.v_p, log.Q_H], axis=1)
    limits = 1.05 * HEIGHT_MIN, HEIGHT_MAX_IN_A * float(p.a.real)
    build_filter(meniscus)(p, A, Q, z, P, R, read, drives, log.gap, log.interval, parts, *limits, *out)
    return out


def _sampled(p: Any, noise: Noise, through: Any, dt: float, meniscus: MeniscusModel) -> tuple[Numbers, Numbers]:
    """Transition over dt [s] at the operating point, and the covariance of the disturbances in it (Van Loan 1978)."""
    n = len(STATES)
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
    F[LOAD, RATE] = 1.0
    A = expm(F * dt)
    for state, sd, tau in ((FAST, noise.fast_sd, TAU_FAST), (SLOW, noise.slow_sd, TAU_SLOW), (RATE, noise.load_rate * through, TAU_RATE)):
        A[state, state] = np.exp(-dt / tau)
        Q[state, state] = sd**2 * (1.0 - A[state, state] ** 2)
    return A, Q


def sensitivities(log: Log, theta: Any, model: Any, meniscus: MeniscusModel = HURLE) -> tuple[Predicted, Any, Any]:
    """Prediction errors at ``theta``, and the derivatives of errors and variances, shape (parameters, rows, 2).

    ``model(theta)`` returns parameters, share of conduction and noise.
    """
    errors, variances = [], []
    out: Predicted | None = None
    for j in range(len(theta)):
        moved = np.array(theta, np.complex128)
        moved[j] += 1j * _STEP
        out = predict(log, *model(moved), meniscus)
        errors.append(out.error.imag / _STEP)
        variances.append(out.variance.imag / _STEP)
    assert out is not None
    return Predicted(*(part.real for part in out)), np.array(errors), np.array(variances)  # type: ignore[arg-type]


def free_model(names: Sequence[str], start: Parameters, noise: Noise) -> Any:
    """The function that turns logarithms of factors (``lam``: the value itself) into parameters, lam and noise."""

    def model(theta: Any) -> tuple[Any, Any, Noise]:
        q, lam, n = start, 0.5 + 0.0j, noise
        for name, value in zip(names, theta, strict=True):
            if name == "lam":
                lam = value
            elif name in Noise._fields:
                n = n._replace(**{name: getattr(noise, name) * np.exp(value)})
            else:
                q = q._replace(**{name: getattr(start, name) * np.exp(value)})
        return q, lam, n

    return model
