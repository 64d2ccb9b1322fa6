"""The recipe ahead: what an observation previews five minutes ahead is remembered until it comes due."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats
from cz_gym.observation import PREVIEWS, Measured


def samples_ahead(dt: float) -> int:
    """Samples in the preview, at the nearest whole number when dt [s] does not divide it."""
    return max(1, round(PREVIEWS[-1] / dt))


def look_ahead(plan: Floats, seen: Measured, starts: npt.NDArray[np.bool_], dt: float) -> Floats:
    """Move the plan on by one sample.

    ``plan`` holds r_ref [m] and T_1_ref [K] (deviations) from now to the end of the preview, shape
    (n, 2, samples ahead + 1); slots that start interpolate the three previewed samples.
    """
    radius = seen.r_ref, seen.r_ref_1min, seen.r_ref_5min
    temperature = seen.T_1_ref, seen.T_1_ref_1min, seen.T_1_ref_5min
    previewed = np.array([radius, temperature]).transpose(2, 0, 1)
    moved = np.concatenate([plan[:, :, 1:], previewed[:, :, -1:]], axis=2)
    moved[:, :, 0] = previewed[:, :, 0]
    if starts.any():
        t = np.minimum(np.arange(plan.shape[2]) * dt, PREVIEWS[-1])
        shares = np.array([np.interp(t, PREVIEWS, one) for one in np.eye(len(PREVIEWS))])
        moved[starts] = (previewed[..., None] * shares).sum(axis=2)[starts]
    return moved
