"""Linear-quadratic regulator with costs on input moves, known disturbances and a previewed reference.

States of the regulator are the plant's five and the previous inputs (v, q); its inputs are the moves of both. The cost
is the reward's, before it saturates. What drives the plant without being moved by it (the disturbance states) enters by
a Sylvester equation instead of the Riccati equation, which would call an integrating disturbance unstabilisable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from cz_gym.baselines.policy import Floats
from cz_gym.cost import WEIGHTS, coefficients

from .model import DRIFT, PLANT, STATES, PlantModel

STEP_TIME = 5.0
"""Control interval [s] that the weights on moves are meant for; at others they keep the same continuous-time law."""


@dataclass(frozen=True)
class Weights:
    """Weights on the terms of the cost, each over its scale in :mod:`cz_gym.cost`; the defaults are the reward's."""

    radius: float = WEIGHTS.radius
    """On (r_c - r_ref)^2."""
    pull: float = WEIGHTS.pull
    """On (v_p - v_0)^2."""
    pull_step: float = WEIGHTS.pull_step
    """On the squared step of v_p."""
    heater_step: float = WEIGHTS.heater_step
    """On the squared step of Q_H."""


class Regulator(NamedTuple):
    """Moves du = -feedback (x_hat - (r_ref, 0, ...), v, q) + sum_j reference_j dr_ref_j + drift_j dp_j.

    dr_ref_j [m] and dp_j [K] are the known increments from t + j dt to t + (j + 1) dt. The least cost from
    z = (plant's five states, previous inputs) and disturbance states d on is z' P z + 2 z' X d, up to terms in d alone.
    """

    feedback: Floats
    """Shape (2, 12): the augmented plant's ten states, then the previous inputs."""
    reference: Floats
    """Shape (samples ahead, 2)."""
    drift: Floats
    """Shape (samples ahead, 2)."""
    P: Floats
    """Shape (7, 7)."""
    X: Floats
    """Shape (7, 5)."""


class Cost(NamedTuple):
    """sum z' Q z + 2 z' N du + du' R du with z = (plant's five states, previous inputs)."""

    Q: Floats
    """Shape (7, 7)."""
    N: Floats
    """Shape (7, 2)."""
    R: Floats
    """Shape (2, 2)."""


def quadratic_cost(weights: Weights, dt: float) -> Cost:
    """The cost's matrices for a control interval of dt [s]."""
    Q, N = np.zeros((PLANT + 2, PLANT + 2)), np.zeros((PLANT + 2, 2))
    per_square, per_step = coefficients(weights), (STEP_TIME / dt) ** 2
    Q[0, 0] = per_square.radius
    Q[PLANT, PLANT] = N[PLANT, 0] = per_square.pull
    moves = per_square.pull + per_step * per_square.pull_step, per_step * per_square.heater_step
    return Cost(Q, N, np.diag(moves))


def regulator(model: PlantModel, weights: Weights, dt: float, ahead: int) -> Regulator:
    """The optimal moves for that plant and cost, with a preview of ``ahead`` samples.

    With P the Riccati solution, S = R + B' P B and A_c the closed loop, a known later change f_j of the state calls for
    -S^-1 B' (A_c')^j P f_j now; disturbances x_d' = A_d x_d entering by E add X = A_c' (P E + X A_d).
    """
    known = len(STATES)
    A = np.block([[model.A[:PLANT, :PLANT], model.B[:PLANT]], [np.zeros((2, PLANT)), np.eye(2)]])
    B = np.vstack([model.B[:PLANT], np.eye(2)])
    E = np.vstack([model.A[:PLANT, PLANT:known], np.zeros((2, known - PLANT))])
    A_d = model.A[PLANT:known, PLANT:known]
    Q, N, R = quadratic_cost(weights, dt)
    P = solve_discrete_are(A, B, Q, R, s=N)
    S = R + B.T @ P @ B
    K = np.linalg.solve(S, B.T @ P @ A + N.T)
    A_c = A - B @ K
    cross = np.eye(E.size) - np.kron(A_c.T, A_d.T)
    X = np.linalg.solve(cross, (A_c.T @ P @ E).ravel()).reshape(E.shape)
    K_d = np.linalg.solve(S, B.T @ (P @ E + X @ A_d))
    moves = np.linalg.solve(S, B.T)
    reference, drift = [], []
    later_reference, later_drift = P[:, 0], X[:, DRIFT - PLANT]
    for _ in range(ahead):
        reference.append(moves @ later_reference)
        drift.append(-moves @ later_drift)
        later_reference, later_drift = A_c.T @ later_reference, A_c.T @ later_drift
    feedback = np.hstack([K[:, :PLANT], K_d, K[:, PLANT:]])
    return Regulator(feedback, np.array(reference), np.array(drift), P, X)
