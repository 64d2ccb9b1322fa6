"""Linear-quadratic problems in stages, solved for a batch by Riccati's recursion.

minimise sum_k 1/2 z' Q z + q' z (after each stage) + 1/2 w' R w + r' w, subject to z_{k+1} = A z_k + B w_k + c_k:
the Newton step of a trajectory. One sweep back and one forward; time grows with the number of stages, not its cube.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cz_gym.baselines.policy import Floats


class Stages(NamedTuple):
    """A problem of N stages for n slots; costs are diagonal."""

    A: Floats
    """Shape (N, n, states, states)."""
    B: Floats
    """Shape (N, n, states, inputs)."""
    c: Floats
    """Constant term of the next state, shape (N, n, states)."""
    Q: Floats
    """Curvature of the cost by the state after the stage, shape (N, n, states)."""
    q: Floats
    """Slope of the cost by the state after the stage, shape (N, n, states)."""
    R: Floats
    """Curvature of the cost by the stage's input, shape (N, n, inputs)."""
    r: Floats
    """Slope of the cost by the stage's input, shape (N, n, inputs)."""


class Law(NamedTuple):
    """w_k = feedback_k z_k + forward_k."""

    feedback: Floats
    """Shape (N, n, inputs, states)."""
    forward: Floats
    """Shape (N, n, inputs)."""


def sweep_back(stages: Stages) -> Law:
    """The law that is optimal for every starting state."""
    N, n, states, inputs = stages.B.shape
    law = Law(np.empty((N, n, inputs, states)), np.empty((N, n, inputs)))
    P, p = np.zeros((n, states, states)), np.zeros((n, states))
    diagonal, own = np.arange(states), np.arange(inputs)
    for k in range(N - 1, -1, -1):
        A, B = stages.A[k], stages.B[k]
        P[:, diagonal, diagonal] += stages.Q[k]
        p = p + stages.q[k] + _times(P, stages.c[k])
        PA, PB = P @ A, P @ B
        H = np.swapaxes(B, 1, 2) @ PB
        H[:, own, own] += stages.R[k]
        G = np.swapaxes(B, 1, 2) @ PA
        g = stages.r[k] + _times(np.swapaxes(B, 1, 2), p)
        both = -np.linalg.solve(H, np.concatenate([G, g[:, :, None]], axis=2))
        K, forward = both[:, :, :-1], both[:, :, -1]
        law.feedback[k], law.forward[k] = K, forward
        P = np.swapaxes(A, 1, 2) @ PA + np.swapaxes(G, 1, 2) @ K
        P = 0.5 * (P + np.swapaxes(P, 1, 2))
        p = _times(np.swapaxes(A, 1, 2), p) + _times(np.swapaxes(G, 1, 2), forward)
    return law


def sweep_forward(stages: Stages, law: Law, start: Floats) -> tuple[Floats, Floats]:
    """States after each stage, shape (N, n, states), and inputs, shape (N, n, inputs), from a start (n, states)."""
    z = start
    after, inputs = np.empty(stages.c.shape), np.empty(law.forward.shape)
    for k in range(len(after)):
        inputs[k] = _times(law.feedback[k], z) + law.forward[k]
        z = after[k] = _times(stages.A[k], z) + _times(stages.B[k], inputs[k]) + stages.c[k]
    return after, inputs


def _times(matrix: Floats, vector: Floats) -> Floats:
    product: Floats = (matrix @ vector[..., None])[..., 0]
    return product
