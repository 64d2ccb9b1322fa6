"""The benchmark's metrics on the true radius, one value an episode, from logged signals; ``return`` alone is reward."""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import COST_CAP, PULL_TOLERANCE, TOLERANCE, moved_mean
from cz_gym.crystal.recipe import CONE_LIMIT, FAILURE_MODES, relative_margin
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .rollout import Rollout

Floats = npt.NDArray[np.float64]
PULL_WINDOW = 30.0 * MINUTE
"""Length of the running mean of the pull speed, on which v/G depends [s]."""

SPEED, OUTSIDE = "microseconds_per_step", "outside_tolerance"
"""Names of two figures of an episode besides its metrics: the time in ``predict`` per step and episode, batched [us];
the share of time outside a tolerance of the radius error [-]."""
ALMOST = 1.0 - 1e-6
"""Share of a limit that counts as the limit itself [-]."""


class Metrics(NamedTuple):
    """Metrics of each episode, shape (episodes,).

    After a failure the radius error counts as the largest allowed one (8 mm on the default puller) to the horizon; what
    describes the drives and the crystal is taken over the steps up to the failure.
    """

    rmse_mm: Floats
    """Root mean square of r_c - r_ref [mm]."""
    rmse_survivors_mm: Floats
    """Root mean square of r_c - r_ref of a crystal that is not lost; NaN if it is [mm]."""
    rmse_observable_mm: Floats
    """Root mean square of r_c against r_ref minus the ring offset that no sensor shows [mm]."""
    max_error_mm: Floats
    """Largest |r_c - r_ref| [mm]."""
    within_half_mm: Floats
    """Share of time with |r_c - r_ref| <= 0.5 mm [-]."""
    pull_rms_mm_per_min: Floats
    """RMS of v_p - v_0 [mm/min]."""
    pull_step_rms_mm_per_min: Floats
    """RMS of the change of v_p from one step to the next [mm/min]."""
    mean_pull_within_3pct: Floats
    """Share of the time after 30 min in which the 30 min mean of v_p is within 3 % of v_0 [-]."""
    heater_step_rms_kw: Floats
    """RMS of the change of Q_H from one step to the next [kW]."""
    time_at_limits: Floats
    """Share of time in which a drive is at its range or moves as fast as it can [-]."""
    growth_rate_rms_mm_per_min: Floats
    """RMS of v_g - v_0 [mm/min]; NaN for a process that logs no growth rate."""
    ground_off_pct: Floats
    """Silicon ground off to a cylinder, 100 (mean r_c^2 / min r_c^2 - 1) [%]."""
    cost: Floats
    """Mean over the steps of the reward's cost before it saturates, which the clairvoyant bound minimises [-]."""
    failure_rate: Floats
    """1 if the episode failed, else 0 [-]."""
    # ``return`` is not a Python name; names_of() restores it.
    return_: Floats
    """Sum of rewards; each step that a lost crystal has left of its horizon counts as the worst one, 1 - 10 [-].

    Otherwise a crystal that is lost at once would earn more than one that is held badly for hours. The environment's
    own reward has no such charge.
    """


def names_of(kind: Any) -> tuple[str, ...]:
    """Return the names of metrics, a type with a field each, as files and tables have them."""
    return tuple(name.rstrip("_") for name in kind._fields)


def metrics(run: Rollout) -> Metrics:
    """Compute the metrics of a rollout."""
    s, alive = run.signals, run.alive
    process, v_0 = run.config.process, run.config.ranges[0]
    value, lost = getattr(s, process.BriefInfo._fields[0]), _lost(run)
    counts = True if (alive | lost).all() else alive | lost  # not after an end with success
    grows = getattr(s, "v_g", np.full(alive.shape, np.nan))
    error, observable = radius_error(run), radius_error(run, s.ring_offset)
    pull_step = np.diff(s.v_p, axis=0, prepend=run.start.v_p)
    heater_step = np.diff(s.Q_H, axis=0, prepend=run.start.Q_H)
    terms = sum(getattr(s, f"term_{name}") for name in process.Cost._fields)
    largest = process.cost_terms(process.Cost(observable, 0.0, 0.0, 0.0), run.config.weights)
    return Metrics(
        rmse_mm=_rms(error, counts) / MM,
        rmse_survivors_mm=np.where(run.failed, np.nan, _rms(error, counts) / MM),
        rmse_observable_mm=_rms(observable, counts) / MM,
        max_error_mm=np.abs(error).max(axis=0, where=counts, initial=0.0) / MM,
        within_half_mm=np.mean(np.abs(error) <= TOLERANCE, axis=0, where=counts),
        pull_rms_mm_per_min=_rms(s.v_p - v_0, alive) / MM_PER_MIN,
        pull_step_rms_mm_per_min=_rms(pull_step, alive) / MM_PER_MIN,
        mean_pull_within_3pct=_mean_pull_share(s.v_p, alive, v_0, run.config.control_interval),
        heater_step_rms_kw=_rms(heater_step, alive) / KILO,
        time_at_limits=np.mean(_at_limits(run), axis=0, where=alive),
        growth_rate_rms_mm_per_min=_rms(grows - v_0, alive) / MM_PER_MIN,
        ground_off_pct=_ground_off(value, alive),
        cost=np.where(lost, largest[0], terms).mean(axis=0, where=counts),
        failure_rate=run.failed.astype(np.float64),
        return_=run.reward.sum(axis=0, where=alive) + (1.0 - COST_CAP) * (lost & ~alive).sum(axis=0),
    )


def radius_error(run: Rollout, offset: Floats | float = 0.0) -> Floats:
    """The radius error plus an offset [m], shape (steps, episodes); from a failing step on the largest allowed one."""
    value, reference = (getattr(run.signals, name) for name in run.config.process.BriefInfo._fields[:2])
    return np.where(_lost(run), run.config.radius_limit, value - reference + offset)


def _lost(run: Rollout) -> npt.NDArray[np.bool_]:
    """True from the failing step of a lost crystal on, shape (steps, episodes)."""
    lost: npt.NDArray[np.bool_] = run.failed & (np.arange(len(run.alive))[:, None] >= run.alive.sum(axis=0) - 1)
    return lost


def outside(run: Rollout, tolerance: float) -> Floats:
    """Share of time with a radius error of more than the tolerance [m], shape (episodes,)."""
    share: Floats = np.mean(np.abs(radius_error(run)) > tolerance, axis=0)
    return share


def _rms(values: Floats, where: npt.NDArray[np.bool_] | bool = True) -> Floats:
    mean: Floats = np.mean(np.square(values), axis=0, where=where)
    return np.sqrt(mean)


def _at_limits(run: Rollout) -> npt.NDArray[np.bool_]:
    """True where a drive is at a limit; limits of a mixture are the widest of its scenarios'.

    The heater's rate is that over the shortest time in which it can make two steps of its resolution.
    """
    config, s, start = run.config, run.signals, run.start
    drives = [each.actuators for each in config.scenario.scenarios]
    window = min(config.ranges[0], max(each.pull_window for each in drives))
    fastest = config.control_interval * max(each.pull_slew for each in drives)
    slew, step = config.control_interval * max(each.heater_slew for each in drives), drives[0].heater_step
    steps = max(1, math.ceil(2.0 * step / slew - 1e-9))
    moved = s.Q_H - np.vstack([np.repeat(start.Q_H, steps, axis=0), s.Q_H])[: len(s.Q_H)]
    pull = (np.abs(s.v_p - start.v_p) >= ALMOST * window) | (
        np.abs(np.diff(s.v_p, axis=0, prepend=start.v_p)) >= ALMOST * fastest
    )
    heater = (np.abs(s.Q_H - start.Q_H) >= ALMOST * config.heater_range - 0.5 * step) | np.less_equal(s.Q_H, 0.5 * step)
    at_limit: npt.NDArray[np.bool_] = pull | heater | (np.abs(moved) >= ALMOST * steps * slew - 0.5 * step)
    return at_limit


def _mean_pull_share(v_p: Floats, alive: npt.NDArray[np.bool_], v_0: float, dt: float) -> Floats:
    window = min(max(round(PULL_WINDOW / dt), 1), len(v_p))
    sums = np.cumsum(np.vstack([np.zeros((1, v_p.shape[1])), v_p]), axis=0)
    means = (sums[window:] - sums[:-window]) / window
    within = (np.abs(means - v_0) <= PULL_TOLERANCE * v_0) & alive[window - 1 :]
    share: Floats = within.mean(axis=0)
    return share


def _ground_off(r_c: Floats, alive: npt.NDArray[np.bool_]) -> Floats:
    mean_square = np.mean(np.square(r_c), axis=0, where=alive)
    smallest = np.min(r_c, axis=0, where=alive, initial=np.inf)
    ground: Floats = 100.0 * (mean_square / np.square(smallest) - 1.0)
    return ground


# The metrics of whole crystals, one value an episode, from logged signals of ``CzCrystal-v0``.

PARTS = ("crown", "body", "tail")
SHARED = (
    "rmse_mm", "rmse_survivors_mm", "rmse_observable_mm", "max_error_mm", "pull_step_rms_mm_per_min",
    "heater_step_rms_kw", "cost", "failure_rate", "return_",
)  # fmt: skip
"""Metrics of a whole crystal with the meaning that they have in :class:`Metrics`."""
KWH = KILO * HOUR
"""One kilowatt hour [J]."""


class CrystalMetrics(NamedTuple):
    """Metrics of each episode, shape (episodes,), over the steps that were grown; NaN for a part that was not."""

    rmse_mm: Floats
    """Root mean square of r_c - r_ref [mm]; after a loss it counts as the largest allowed one of the body."""
    rmse_survivors_mm: Floats
    """Root mean square of r_c - r_ref of a crystal that is not lost; NaN if it is [mm]."""
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
    """Share of the body's length in which the 30 min mean of v/G is within 10 % of the recipe's [-]."""
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
    """1 if the crystal was lost in the body, else 0 [-]."""
    lost_in_tail: Floats
    """1 if the crystal was lost in the tail, else 0 [-]."""
    frozen: Floats
    """1 if the crystal was lost because its meniscus was too low, else 0 [-]."""
    detached: Floats
    """1 if the crystal was lost because its meniscus was too high, else 0 [-]."""
    off: Floats
    """1 if the crystal was lost because its radius error was too large, else 0 [-]."""
    cold: Floats
    """1 if the crystal was lost because its melt was below the melting point, else 0 [-]."""
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
    how = np.where(
        run.failed, np.argmin(relative_margin(ends, run.config.radius_limit, run.config.parameters), axis=0), -1
    )
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
        **{way: (how == number).astype(np.float64) for number, way in enumerate(FAILURE_MODES)},
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


def _share(values: npt.NDArray[Any], weights: npt.NDArray[Any]) -> Floats:
    """Mean of each episode with these weights, shape (steps, episodes); NaN where they are all zero."""
    total = weights.sum(axis=0, dtype=np.float64)
    kept = np.where(weights > 0, values, 0.0)  # a signal after a loss may be anything
    share: Floats = np.where(total > 0.0, np.sum(kept * weights, axis=0) / np.where(total > 0.0, total, 1.0), np.nan)
    return share
