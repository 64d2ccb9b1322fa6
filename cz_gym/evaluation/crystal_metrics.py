"""The metrics of whole crystals, one value an episode, from logged signals of ``CzCrystal-v0``."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.cost import PULL_TOLERANCE, TOLERANCE, moved_mean
from cz_gym.crystal.process import CRYSTAL
from cz_gym.crystal.task import CONE_LIMIT, WAYS, room
from cz_gym.process import Process
from cz_gym.support.units import HOUR, KILO, MM

from .metrics import Metrics, metrics
from .rollout import Rollout

Floats = npt.NDArray[np.float64]
PARTS = ("crown", "body", "tail")
SHARED = (
    "rmse_mm", "rmse_survivors_mm", "rmse_observable_mm", "max_error_mm", "pull_step_rms_mm_per_min",
    "heater_step_rms_kw", "cost", "failure_rate", "return_",
)  # fmt: skip
"""Metrics of :class:`cz_gym.evaluation.metrics.Metrics` that mean the same here."""
KWH = KILO * HOUR
"""One kilowatt hour [J]."""


class CrystalMetrics(NamedTuple):
    """Metrics of each episode, shape (episodes,), over the steps that were grown; NaN for a part that was not."""

    rmse_mm: Floats
    """Root mean square of r_c - r_ref [mm]; after a loss it counts as the largest allowed one of the body."""
    rmse_survivors_mm: Floats
    """The same of a crystal that is not lost; NaN if it is [mm]."""
    rmse_observable_mm: Floats
    """Root mean square of r_c against r_ref minus the ring offset that no sensor shows [mm]."""
    max_error_mm: Floats
    """Largest |r_c - r_ref| [mm]."""
    crown_max_mm: Floats
    """Largest |r_c - r_ref| in the crown [mm]; the largest allowed one if the crystal is lost there."""
    body_rmse_mm: Floats
    """Root mean square of r_c - r_ref in the body [mm]."""
    body_within_half: Floats
    """Share of the body's length with |r_c - r_ref| <= 0.5 mm [-]."""
    tail_max_mm: Floats
    """Largest |r_c - r_ref| in the tail [mm]; the largest allowed one if the crystal is lost there."""
    v_over_G_within_3pct: Floats
    """Share of the body's length in which the 30 min mean of v/G is within 3 % of the recipe's [-]."""
    v_over_G_within_10pct: Floats
    """The same within 10 % [-]."""
    hours: Floats
    """Time grown [h]."""
    kwh_per_kg: Floats
    """Energy of the heater by mass grown [kWh/kg]."""
    dopant_spread: Floats
    """Largest over smallest dopant that the body took up, minus one [-]."""
    pull_step_rms_mm_per_min: Floats
    """RMS of the change of v_p from one step to the next [mm/min]."""
    heater_step_rms_kw: Floats
    """RMS of the change of Q_H from one step to the next [kW]."""
    cost: Floats
    """Mean over the steps of the reward's cost before it saturates [-]."""
    completed: Floats
    """1 if the length was reached, else 0 [-]."""
    lost_in_crown: Floats
    """1 if the crystal was lost in the crown, else 0 [-]."""
    lost_in_body: Floats
    """The same of the body [-]."""
    lost_in_tail: Floats
    """The same of the tail [-]."""
    frozen: Floats
    """1 if the crystal was lost because its meniscus was too low, else 0 [-]."""
    detached: Floats
    """The same of a meniscus that was too high [-]."""
    off: Floats
    """The same of a radius error that was too large [-]."""
    cold: Floats
    """The same of a melt below its melting point [-]."""
    failure_rate: Floats
    """1 if the crystal was lost, else 0 [-]."""
    return_: Floats
    """Sum of rewards, as that of ``Cz-v0``'s metrics."""


def crystal_metrics(run: Rollout) -> CrystalMetrics:
    """Compute the metrics of a rollout of whole crystals, or parts of them."""
    s, dt, common = run.signals, run.config.control_interval, metrics(run)
    crown, body, tail = (run.alive & (s.stage == part) for part in range(len(PARTS)))
    last, every = run.alive.sum(axis=0) - 1, np.arange(len(run.failed))
    error, limit = np.abs(s.r_c - s.r_ref), CONE_LIMIT * run.config.radius_limit
    lost_in = np.where(run.failed, s.stage[last, every], np.nan)
    ends = type(s)(*(signal[last, every] for signal in s))
    how = np.where(run.failed, np.argmin(room(ends, run.config.radius_limit, run.config.parameters), axis=0), -1)
    grown = np.maximum(np.diff(s.L, axis=0, prepend=run.start.L), 0.0) * body
    v_over_G = np.abs(_mean(s.v_over_G, dt) - 1.0)
    return CrystalMetrics(
        **{name: getattr(common, name) for name in SHARED},
        crown_max_mm=np.where(lost_in == 0, limit, _most(error, crown)) / MM,
        body_rmse_mm=np.sqrt(_share(np.square(error), body)) / MM,
        body_within_half=_share(error <= TOLERANCE, grown),
        tail_max_mm=np.where(lost_in == 2, limit, _most(error, tail)) / MM,
        v_over_G_within_3pct=_share(v_over_G <= PULL_TOLERANCE, grown),
        v_over_G_within_10pct=_share(v_over_G <= 0.10, grown),
        hours=(last + 1) * dt / HOUR,
        kwh_per_kg=np.sum(s.Q_H, axis=0, where=run.alive) * dt / KWH / (ends.M_s - run.start.M_s[0]),
        dopant_spread=_most(s.dopant, body) / -_most(-s.dopant, body) - 1.0,
        completed=_most(s.succeeded, run.alive),
        **{f"lost_in_{part}": (lost_in == number).astype(np.float64) for number, part in enumerate(PARTS)},
        **{way: (how == number).astype(np.float64) for number, way in enumerate(WAYS)},
    )


def kind_of(process: Process) -> Any:
    """The type of a process' metrics."""
    return CrystalMetrics if process == CRYSTAL else Metrics


def measured(run: Rollout) -> Any:
    """The metrics of a rollout, of the type of its process."""
    return crystal_metrics(run) if run.config.process == CRYSTAL else metrics(run)


def _mean(values: Floats, dt: float) -> Floats:
    """Exponential 30 min mean along the steps, from 1 on."""
    mean, means = np.ones(values.shape[1]), np.empty_like(values)
    for k, row in enumerate(values):
        mean = means[k] = moved_mean(mean, row, dt)
    return means


def _most(values: Floats, where: npt.NDArray[np.bool_]) -> Floats:
    most = np.max(values, axis=0, where=where, initial=-np.inf)
    return np.where(where.any(axis=0), most, np.nan)


def _share(values: npt.NDArray[Any], weights: npt.NDArray[Any]) -> Floats:
    """Mean of each episode with these weights, shape (steps, episodes); NaN where they are all zero."""
    total = weights.sum(axis=0, dtype=np.float64)
    kept = np.where(weights > 0, values, 0.0)  # a signal after a loss may be anything
    share: Floats = np.where(total > 0.0, np.sum(kept * weights, axis=0) / np.where(total > 0.0, total, 1.0), np.nan)
    return share
