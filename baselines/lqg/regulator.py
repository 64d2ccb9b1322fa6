"""Linear-quadratic regulator with costs on input moves, known disturbances and a previewed reference.

The disturbance states, which drive the plant and are not moved by it, enter by a Sylvester equation: in the Riccati
equation an integrating disturbance would be unstabilisable.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are

from cz_gym.baselines.policy import Floats
from cz_gym.body.cost import Weights, coefficients
from cz_gym.observation import PREVIEWS, Measured
from cz_gym.support.units import MM_PER_MIN

from .model import DRIFT, PLANT, STATES, PlantModel

PULL_SCALE = 0.36 * MM_PER_MIN
"""Deviation of the pull speed at which its quadratic term equals its weight [m/s]; the reward charges its mean, beyond
a band."""
STEP_TIME = 5.0
"""Control interval [s] of the weights on moves; at other intervals the continuous-time law stays the same."""


class Regulator(NamedTuple):
    """Moves du = -feedback (x_hat - (r_ref, 0, ...), v, q) + sum_j reference_j dr_ref_j + drift_j dp_j.

    dr_ref_j [m] and dp_j [K] are the known increments from t + j dt to t + (j + 1) dt. The least cost from
    z = (plant's five states, previous inputs) and disturbance states d on is z' P z + 2 z' X d, up to terms in d alone.
    ``feedback`` has shape (2, 12): the augmented plant's ten states, then the previous inputs; ``reference`` and
    ``drift`` have shape (samples ahead, 2), P (7, 7), X (7, 5).
    """

    feedback: Floats
    reference: Floats
    drift: Floats
    P: Floats
    X: Floats


def quadratic_cost(weights: Weights, dt: float) -> tuple[Floats, Floats, Floats]:
    """Q, N and R of the cost sum z' Q z + 2 z' N du + du' R du, z = (plant's states, previous inputs), for dt [s]."""
    Q, N = np.zeros((PLANT + 2, PLANT + 2)), np.zeros((PLANT + 2, 2))
    per_square, pull = coefficients(weights), weights.pull / PULL_SCALE**2
    per_step = (STEP_TIME / dt) ** 2
    Q[0, 0] = per_square.radius
    Q[PLANT, PLANT] = N[PLANT, 0] = pull
    R = np.diag([pull + per_step * per_square.pull_step, per_step * per_square.heater_step])
    return Q, N, R


def regulator(model: PlantModel, weights: Weights, dt: float) -> Regulator:
    """The optimal moves for that plant and cost, with the preview of the observations.

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
    for _ in range(samples_ahead(dt)):
        reference.append(moves @ later_reference)
        drift.append(-moves @ later_drift)
        later_reference, later_drift = A_c.T @ later_reference, A_c.T @ later_drift
    feedback = np.hstack([K[:, :PLANT], K_d, K[:, PLANT:]])
    return Regulator(feedback, np.array(reference), np.array(drift), P, X)


def samples_ahead(dt: float) -> int:
    """Number of samples in the preview; the nearest whole number if dt [s] does not divide it."""
    return max(1, round(PREVIEWS[-1] / dt))


def look_ahead(plan: Floats, seen: Measured, starts: npt.NDArray[np.bool_], dt: float) -> Floats:
    """The recipe ahead after one more sample.

    ``plan`` holds r_ref [m] and T_1_ref [K] (deviations) from now to the end of the preview, shape
    (n, 2, samples ahead + 1). In slots that start it is interpolated from the three previewed samples.
    """
    radius = seen.r_ref, seen.r_ref_1min, seen.r_ref_5min
    temperature = seen.T_1_ref, seen.T_1_ref_1min, seen.T_1_ref_5min
    previewed = np.stack([np.stack(radius), np.stack(temperature)]).transpose(2, 0, 1)
    moved = np.concatenate([plan[:, :, 1:], previewed[:, :, -1:]], axis=2)
    moved[:, :, 0] = previewed[:, :, 0]
    if starts.any():
        t = np.minimum(np.arange(plan.shape[2]) * dt, PREVIEWS[-1])
        shares = np.array([np.interp(t, PREVIEWS, one) for one in np.eye(len(PREVIEWS))])
        moved[starts] = (previewed[..., None] * shares).sum(axis=2)[starts]
    return moved
