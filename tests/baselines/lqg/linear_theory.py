"""The LQG on the linear plant: its covariance equation, and itself as one linear system.

Only for the steady filter on the linearised plant: noise of known variance, every frame valid, no limit reached.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from cz_gym.baselines.policy import Floats
from cz_gym.physics.linearisation import StateSpace
from cz_gym.task import Cost, cost_terms
from cz_gym.units import HOUR, KILO, MM, MM_PER_MIN

from . import kalman
from .controller import Gains
from .model import PLANT, STATES, PlantModel

FLUCTUATING = PLANT + 2
"""States of the plant and its two interface fluctuations: what is stationary."""
_PLANT_SCALES = np.array([MM, MM, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / HOUR, KILO])


class Loop(NamedTuple):
    """s_{k+1} = A s_k + B n_k with s = (x, x_hat before the reading, previous inputs); all stationary.

    m = 19 states, and two more for each of a late or shaken ring.
    """

    A: Floats
    """Shape (m, m)."""
    B: Floats
    """Shape (m, noises)."""
    signals: Floats
    """Rows giving r_c, v_p, and the steps of v_p and Q_H from (s, n), shape (4, m + noises)."""
    scales: Floats
    """Units in which the states are of one order, shape (m,); the covariance equation is ill-conditioned in SI."""


def steady_gain(gains: Gains) -> Floats:
    """Kalman gain of readings (r_br, T_1) the filter settles at, shape (states, 2)."""
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
    F, K_u = np.split(gains.regulator.feedback, [len(STATES)], axis=1)
    F = np.pad(F, ((0, 0), (0, len(model.A) - len(STATES))))
    corrected = np.eye(len(model.A)) - K @ model.H
    C = np.hstack([-F @ corrected, np.eye(2) - K_u])
    D = -F @ K
    moved = np.hstack([model.A @ corrected, np.zeros((len(model.A), 2))]) + model.B @ C
    return StateSpace(np.vstack([moved, C]), np.vstack([model.A @ K + model.B @ D, D]), C, D)


def closed_loop(gains: Gains) -> Loop:
    """The controller around the plant it is designed for, driven by fluctuations and sensor noise of unit variance."""
    model, noise, law = gains.eye.model, gains.eye.noise, controller(gains)
    moving = stationary(model)
    n, m, both = len(moving), len(law.A), np.ix_(moving, moving)
    A, B, H = model.A[both], model.B[moving], model.H[:, moving]
    w = _root(model.Q[both])
    v = np.diag([noise.camera_sd, noise.pyrometer_sd])
    inputs = np.hstack([law.D @ H, law.C, np.zeros((2, n)), law.D @ v])
    state = np.hstack([A, np.zeros((n, m)), w, np.zeros((n, 2))]) + B @ inputs
    memory = np.hstack([law.B @ H, law.A, np.zeros((m, n)), law.B @ v])
    previous = np.zeros((2, inputs.shape[1]))
    previous[:, n + m - 2 : n + m] = np.eye(2)
    radius = np.zeros((1, inputs.shape[1]))
    radius[0, 0] = 1.0
    together = np.vstack([state, memory])
    own = np.concatenate([_PLANT_SCALES, np.full(len(model.A) - len(STATES), MM)])
    scales = np.concatenate([own[moving], own, [MM_PER_MIN, KILO]])
    signals = np.vstack([radius, inputs[:1], inputs - previous])
    return Loop(together[:, : n + m], together[:, n + m :], signals, scales)


def stationary(model: PlantModel) -> list[int]:
    """Indices of the states that are stationary in a loop: plant, interface fluctuations, ripple and past rings."""
    return [*range(FLUCTUATING), *range(len(STATES), len(model.A))]


def stationary_cost(gains: Gains) -> Cost:
    """Mean of the reward's terms, before it saturates, by the covariance equation P = A P A' + B B' (Lyapunov)."""
    loop = closed_loop(gains)
    A = loop.A / loop.scales[:, None] * loop.scales
    B = loop.B / loop.scales[:, None]
    P = solve_discrete_lyapunov(A, B @ B.T, method="direct") * np.outer(loop.scales, loop.scales)
    by_state, by_noise = np.split(loop.signals, [len(loop.A)], axis=1)
    mean_squares = np.diag(by_state @ P @ by_state.T + by_noise @ by_noise.T)
    return Cost(*(float(term) for term in cost_terms(*np.sqrt(mean_squares))))


def _root(Q: Floats) -> Floats:
    """A matrix whose product with its transpose is the covariance Q."""
    values, vectors = np.linalg.eigh(Q)
    root: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
