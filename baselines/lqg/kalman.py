"""An extended Kalman filter for a batch of slots, one scalar measurement at a time.

Every slot has its own covariance, because episodes start, frames are missing, the ring's slope changes with the
meniscus, and the camera's noise is unknown. On a linear plant with constant noise the filter settles at the solution of
the Riccati equation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats


class Gaussian(NamedTuple):
    """An estimate and its uncertainty, by slot."""

    mean: Floats
    """Shape (n, states)."""
    covariance: Floats
    """Shape (n, states, states)."""


class Measurement(NamedTuple):
    """One scalar measurement, by slot."""

    innovation: Floats
    """Measured less expected value, shape (n,)."""
    row: Floats
    """Derivative of the expected value by the state, shape (n, states)."""
    variance: Floats
    """Variance of the noise, shape (n,); infinite where nothing was measured."""


def predicted_covariance(P: Floats, A: Floats, Q: Floats) -> Floats:
    """A P A' + Q for P of shape (n, states, states); A and Q have the same shape or are shared by the slots."""
    predicted: Floats = A @ P @ np.swapaxes(A, -1, -2) + Q
    return predicted


def correct(estimate: Gaussian, measurement: Measurement, gate: float) -> Gaussian:
    """The estimate after one measurement, with the gain K = P h / (h' P h + R).

    Innovations are clipped to +-``gate`` standard deviations (Huber's limit): an outlier does little harm, and a real
    change is still followed.
    """
    P = estimate.covariance
    Ph = (P @ measurement.row[..., None])[..., 0]
    S = innovation_variance(estimate, measurement)
    limit = gate * np.sqrt(S)
    with np.errstate(invalid="ignore"):
        used = np.where(np.isfinite(S), np.clip(measurement.innovation, -limit, limit), 0.0) / S
    K = Ph / S[:, None]
    return Gaussian(estimate.mean + Ph * used[:, None], P - K[:, :, None] * Ph[:, None, :])


def innovation_variance(estimate: Gaussian, measurement: Measurement) -> Floats:
    """h' P h + R, shape (n,)."""
    Ph = (estimate.covariance @ measurement.row[..., None])[..., 0]
    variance: Floats = np.einsum("ni,ni->n", Ph, measurement.row) + measurement.variance
    return variance


def matched_variance(
    variance: Floats,
    innovation: Floats,
    predicted: Floats,
    valid: npt.NDArray[np.bool_],
    keep: float,
    limits: tuple[float, float],
    gate: float,
) -> Floats:
    """Variance of a sensor's noise by covariance matching: a running mean of innovation^2 - h' P h (Mehra 1972).

    ``variance`` is the old value and ``keep`` its weight in the new one; ``predicted`` is h' P h. Innovations are
    clipped to +-``gate`` standard deviations, the variance to ``limits``; samples that are not ``valid`` are left out.
    """
    square = np.minimum(np.square(innovation), gate**2 * (predicted + variance))
    matched = keep * variance + (1.0 - keep) * (square - predicted)
    return np.where(valid, np.clip(matched, *limits), variance)
