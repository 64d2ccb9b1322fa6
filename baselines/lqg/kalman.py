"""An extended Kalman filter over a batch of slots, one scalar reading at a time.

Every slot carries its own covariance, so that starts, missing frames, a ring whose slope changes with the meniscus and
a camera of unknown noise need no cases of their own. On a linear plant with constant noise it settles at the Riccati
equation's solution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are

from cz_gym.baselines.policy import Floats


class Gaussian(NamedTuple):
    """What a filter believes, by slot."""

    mean: Floats
    """Shape (n, states)."""
    covariance: Floats
    """Shape (n, states, states)."""


class Reading(NamedTuple):
    """One scalar measurement by slot."""

    innovation: Floats
    """Reading less what the estimate makes of it, shape (n,)."""
    row: Floats
    """Derivative of the reading by the state, shape (n, states)."""
    variance: Floats
    """Variance of its noise, shape (n,); infinite where there is no reading."""


def predicted_covariance(P: Floats, A: Floats, Q: Floats) -> Floats:
    """A P A' + Q; P of shape (n, states, states), A and Q of the same or shared by the slots."""
    predicted: Floats = A @ P @ np.swapaxes(A, -1, -2) + Q
    return predicted


def correct(belief: Gaussian, reading: Reading, gate: float) -> Gaussian:
    """Use one reading: K = P h / (h' P h + R).

    An innovation beyond ``gate`` standard deviations counts as that much (Huber's limit), so that an outlier does
    little harm and a real change is followed still.
    """
    P = belief.covariance
    Ph = (P @ reading.row[..., None])[..., 0]
    S = innovation_variance(belief, reading)
    limit = gate * np.sqrt(S)
    with np.errstate(invalid="ignore"):
        used = np.where(np.isfinite(S), np.clip(reading.innovation, -limit, limit), 0.0) / S
    K = Ph / S[:, None]
    return Gaussian(belief.mean + Ph * used[:, None], P - K[:, :, None] * Ph[:, None, :])


def innovation_variance(belief: Gaussian, reading: Reading) -> Floats:
    """h' P h + R, shape (n,)."""
    Ph = (belief.covariance @ reading.row[..., None])[..., 0]
    variance: Floats = np.einsum("ni,ni->n", Ph, reading.row) + reading.variance
    return variance


def observed_noise(
    variance: Floats,
    innovation: Floats,
    predicted: Floats,
    seen: npt.NDArray[np.bool_],
    keep: float,
    limits: tuple[float, float],
    gate: float,
) -> Floats:
    """Variance of a sensor's noise by covariance matching: a running mean of innovation^2 - h' P h (Mehra 1972).

    ``predicted`` is h' P h; ``keep`` the share of the old value that stays; samples not ``seen`` change nothing and
    innovations beyond ``gate`` standard deviations count as that much. The variance stays within ``limits``.
    """
    square = np.minimum(np.square(innovation), gate**2 * (predicted + variance))
    matched = keep * variance + (1.0 - keep) * (square - predicted)
    return np.where(seen, np.clip(matched, *limits), variance)


def steady_state(A: Floats, H: Floats, Q: Floats, R: Floats) -> Floats:
    """Covariance of the prediction error a linear filter settles at (SciPy's Riccati solver).

    P = A P A' - A P H' (H P H' + R)^-1 H P A' + Q
    """
    P: Floats = np.asarray(solve_discrete_are(A.T, H.T, Q, R), np.float64)
    return P
