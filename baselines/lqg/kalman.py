"""An extended Kalman filter for a batch of slots, each with its own covariance, one scalar measurement at a time."""

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats


def correct(
    mean: Floats, P: Floats, row: Floats, innovation: Floats, variance: Floats, gate: float
) -> tuple[Floats, Floats]:
    """The mean and the covariance after one measurement, with the gain K = P h / (h' P h + R).

    ``innovation`` is the measured less the expected value, shape (n,), ``row`` (h) the derivative of the expected value
    by the state, shape (n, states), ``variance`` (R) that of the noise, infinite where nothing was measured.
    Innovations are clipped to +-``gate`` standard deviations (Huber's limit).
    """
    Ph = (P @ row[..., None])[..., 0]
    S = expected_variance(P, row) + variance
    limit = gate * np.sqrt(S)
    with np.errstate(invalid="ignore"):
        used = np.where(np.isfinite(S), np.clip(innovation, -limit, limit), 0.0) / S
    K = Ph / S[:, None]
    return mean + Ph * used[:, None], P - K[:, :, None] * Ph[:, None, :]


def expected_variance(P: Floats, row: Floats) -> Floats:
    """Variance h' P h of the expected value of a measurement, shape (n,)."""
    variance: Floats = np.einsum("ni,ni->n", (P @ row[..., None])[..., 0], row)
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
