"""The benchmark's metrics on the true radius, one value an episode, from logged signals; ``return`` alone is reward."""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.cost import COST_CAP, PULL_TOLERANCE, TOLERANCE
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .rollout import Rollout

Floats = npt.NDArray[np.float64]
PULL_WINDOW = 30.0 * MINUTE
"""Length of the running mean of the pull speed, on which v/G depends [s]."""

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
    """The same of a crystal that is not lost; NaN if it is [mm]."""
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


def metric_names() -> tuple[str, ...]:
    """Return the names of ``Cz-v0``'s metrics."""
    return names_of(Metrics)


def metrics(run: Rollout) -> Metrics:
    """Compute the metrics of a rollout."""
    s, alive = run.signals, run.alive
    process, v_0 = run.config.process, run.config.ranges[0]
    value, lost = getattr(s, process.Lean._fields[0]), _lost(run)
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
    value, reference = (getattr(run.signals, name) for name in run.config.process.Lean._fields[:2])
    return np.where(_lost(run), run.config.radius_limit, value - reference + offset)


def _lost(run: Rollout) -> npt.NDArray[np.bool_]:
    """Whether a crystal is lost, from its failing step on, shape (steps, episodes)."""
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
    """Whether a drive is at a limit; those of a mixture are the widest of its scenarios'.

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
