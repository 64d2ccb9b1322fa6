"""The LQG on the linear plant: its covariance equation, and itself as one linear system.

Only for the steady filter on the linearised plant: noise of known variance, every frame valid, no limit reached.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from cz_gym.linear import StateSpace
from cz_gym.task import Cost, cost_terms
from cz_gym.units import HOUR, KILO, MM, MM_PER_MIN

from . import kalman
from .lqg import Gains
from .lqg_model import PLANT
from .policy import Floats

FLUCTUATING = PLANT + 2
"""States of the plant and its two interface fluctuations: what is stationary."""
_PLANT_SCALES = np.array([MM, MM, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / HOUR, KILO])
_SCALES = np.concatenate([_PLANT_SCALES[:FLUCTUATING], _PLANT_SCALES, [MM_PER_MIN, KILO]])
"""Units in which the loop's states are of one order; the covariance equation is ill-conditioned in SI."""


class Loop(NamedTuple):
    """s_{k+1} = A s_k + B n_k with s = (x, x_hat before the reading, previous inputs); all stationary."""

    A: Floats
    """Shape (19, 19)."""
    B: Floats
    """Shape (19, noises)."""
    signals: Floats
    """Rows giving r_c, v_p, and the steps of v_p and Q_H from (s, n), shape (4, 19 + noises)."""


def steady_gain(gains: Gains) -> Floats:
    """Kalman gain of readings (r_br, T_1) the filter settles at, shape (10, 2)."""
    A, _, H, Q, _ = gains.eye.model
    noise = gains.eye.noise
    R = np.diag([noise.camera_sd**2, noise.pyrometer_sd**2])
    P = kalman.steady_state(A, H, Q, R)
    gain: Floats = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return gain


def controller(gains: Gains) -> StateSpace:
    """The controller as a sampled linear system from (r_br - r_0 - bias, T_1 - T_1,0) to (v_p - v_0, Q_H - Q_H0).

    States: the prediction x_hat, and the previous inputs; SI units. The reference is held at r_0.
    """
    model, K = gains.eye.model, steady_gain(gains)
    F, K_u = np.split(gains.regulator.feedback, [len(model.A)], axis=1)
    corrected = np.eye(len(model.A)) - K @ model.H
    C = np.hstack([-F @ corrected, np.eye(2) - K_u])
    D = -F @ K
    moved = np.hstack([model.A @ corrected, np.zeros((len(model.A), 2))]) + model.B @ C
    return StateSpace(np.vstack([moved, C]), np.vstack([model.A @ K + model.B @ D, D]), C, D)


def closed_loop(gains: Gains) -> Loop:
    """The controller around the plant it is designed for, driven by fluctuations and sensor noise of unit variance."""
    model, noise, law = gains.eye.model, gains.eye.noise, controller(gains)
    n, m = FLUCTUATING, len(law.A)
    A, B, H = model.A[:n, :n], model.B[:n], model.H[:, :n]
    w = _root(model.Q[:n, :n])
    v = np.diag([noise.camera_sd, noise.pyrometer_sd])
    inputs = np.hstack([law.D @ H, law.C, np.zeros((2, n)), law.D @ v])
    state = np.hstack([A, np.zeros((n, m)), w, np.zeros((n, 2))]) + B @ inputs
    memory = np.hstack([law.B @ H, law.A, np.zeros((m, n)), law.B @ v])
    previous = np.zeros((2, inputs.shape[1]))
    previous[:, n + m - 2 : n + m] = np.eye(2)
    radius = np.zeros((1, inputs.shape[1]))
    radius[0, 0] = 1.0
    both = np.vstack([state, memory])
    return Loop(both[:, : n + m], both[:, n + m :], np.vstack([radius, inputs[:1], inputs - previous]))


def stationary_cost(gains: Gains) -> Cost:
    """Mean of the reward's terms, before it saturates, by the covariance equation P = A P A' + B B' (Lyapunov)."""
    loop = closed_loop(gains)
    A = loop.A / _SCALES[:, None] * _SCALES
    B = loop.B / _SCALES[:, None]
    P = solve_discrete_lyapunov(A, B @ B.T, method="direct") * np.outer(_SCALES, _SCALES)
    by_state, by_noise = np.split(loop.signals, [len(loop.A)], axis=1)
    mean_squares = np.diag(by_state @ P @ by_state.T + by_noise @ by_noise.T)
    return Cost(*(float(term) for term in cost_terms(*np.sqrt(mean_squares))))


def _root(Q: Floats) -> Floats:
    """A matrix whose product with its transpose is the covariance Q."""
    values, vectors = np.linalg.eigh(Q)
    root: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
