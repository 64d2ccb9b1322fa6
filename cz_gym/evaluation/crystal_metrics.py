"""The metrics of whole crystals, one value an episode, from logged signals of ``CzCrystal-v0``."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.cost import PULL_TOLERANCE, TOLERANCE, moved_mean
from cz_gym.support.units import HOUR, KILO, MM

from .rollout import Rollout

Floats = npt.NDArray[np.float64]
PARTS = ("crown", "body", "tail")
KWH = KILO * HOUR
"""One kilowatt hour [J]."""


class CrystalMetrics(NamedTuple):
    """Metrics of each episode, shape (episodes,), over the steps that were grown; NaN for a part that was not."""

    completed: Floats
    """1 if the length was reached [-]."""
    crown_max_mm: Floats
    """Largest |r_c - r_ref| in the crown [mm]."""
    body_rmse_mm: Floats
    """Root mean square of r_c - r_ref in the body [mm]."""
    body_within_half: Floats
    """Share of the body's time with |r_c - r_ref| <= 0.5 mm [-]."""
    tail_max_mm: Floats
    """Largest |r_c - r_ref| in the tail [mm]."""
    v_over_G_within_3pct: Floats
    """Share of the body's time in which the 30 min mean of v/G is within 3 % of the recipe's [-]."""
    v_over_G_within_10pct: Floats
    """The same within 10 % [-]."""
    hours: Floats
    """Time grown [h]."""
    kwh_per_kg: Floats
    """Energy of the heater by mass grown [kWh/kg]."""
    dopant_spread: Floats
    """Largest over smallest dopant that the body took up, minus one [-]."""
    lost_in: Floats
    """Part in which the crystal was lost: 0 crown, 1 body, 2 tail; NaN if it was not."""


def crystal_metrics(run: Rollout) -> CrystalMetrics:
    """Compute the metrics of a rollout of whole crystals, or parts of them."""
    s, dt = run.signals, run.config.control_interval
    crown, body, tail = (run.alive & (s.stage == part) for part in range(len(PARTS)))
    error = np.abs(s.r_c - s.r_ref)
    v_over_G = np.abs(_mean(s.v_over_G, dt) - 1.0)
    last = run.alive.sum(axis=0) - 1
    every = np.arange(len(last))
    grown = s.M_s[last, every] - run.start.M_s[0]
    dopant = _most(s.dopant, body) / -_most(-s.dopant, body) - 1.0
    return CrystalMetrics(
        completed=_most(s.succeeded, run.alive),
        crown_max_mm=_most(error, crown) / MM,
        body_rmse_mm=np.sqrt(_share(np.square(error), body)) / MM,
        body_within_half=_share(error <= TOLERANCE, body),
        tail_max_mm=_most(error, tail) / MM,
        v_over_G_within_3pct=_share(v_over_G <= PULL_TOLERANCE, body),
        v_over_G_within_10pct=_share(v_over_G <= 0.10, body),
        hours=(last + 1) * dt / HOUR,
        kwh_per_kg=np.sum(s.Q_H, axis=0, where=run.alive) * dt / KWH / grown,
        dopant_spread=dopant,
        lost_in=np.where(run.failed, s.stage[last, every], np.nan),
    )


def _mean(values: Floats, dt: float) -> Floats:
    """Exponential 30 min mean along the steps, from 1 on."""
    mean, means = np.ones(values.shape[1]), np.empty_like(values)
    for k, row in enumerate(values):
        mean = means[k] = moved_mean(mean, row, dt)
    return means


def _most(values: Floats, where: npt.NDArray[np.bool_]) -> Floats:
    most = np.max(values, axis=0, where=where, initial=-np.inf)
    return np.where(where.any(axis=0), most, np.nan)


def _share(values: npt.NDArray[np.generic], where: npt.NDArray[np.bool_]) -> Floats:
    counts = where.sum(axis=0)
    total = np.sum(values, axis=0, where=where, dtype=np.float64)
    share: Floats = np.where(counts > 0, total / np.maximum(counts, 1), np.nan)
    return share
