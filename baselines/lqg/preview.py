"""The recipe ahead: what was shown five minutes ahead, remembered until it comes due."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats
from cz_gym.observation import PREVIEWS, Measured


def samples_ahead(dt: float) -> int:
    """Samples in the preview, at the nearest whole number when dt [s] does not divide it."""
    return max(1, round(PREVIEWS[-1] / dt))


def look_ahead(plan: Floats, seen: Measured, begins: npt.NDArray[np.bool_], dt: float) -> Floats:
    """Move the plan on by one sample.

    ``plan`` holds r_ref [m] and T_1_ref [K] (deviations) from now to the end of the preview, shape
    (n, 2, samples ahead + 1); slots that begin interpolate the three samples they are shown.
    """
    shown = [
        np.stack(pair, axis=-1)
        for pair in (
            (seen.r_ref, seen.T_1_ref),
            (seen.r_ref_1min, seen.T_1_ref_1min),
            (seen.r_ref_5min, seen.T_1_ref_5min),
        )
    ]
    moved = np.concatenate([plan[:, :, 1:], shown[-1][:, :, None]], axis=2)
    moved[:, :, 0] = shown[0]
    if begins.any():
        moved[begins] = _interpolated(shown, plan.shape[2], dt)[begins]
    return moved


def _interpolated(shown: list[Floats], samples: int, dt: float) -> Floats:
    t = np.minimum(np.arange(samples) * dt, PREVIEWS[-1])
    shares = [np.interp(t, PREVIEWS, np.eye(len(PREVIEWS))[i]) for i in range(len(PREVIEWS))]
    total: Floats = sum(values[:, :, None] * share for values, share in zip(shown, shares, strict=True))
    return total
