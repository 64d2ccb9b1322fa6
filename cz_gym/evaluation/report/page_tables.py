"""What the page's table and pictures show: columns, every controller's estimates, every episode's errors."""

from __future__ import annotations

from typing import Any, NamedTuple

from cz_gym.evaluation.results import REFERENCE, Benchmark, Outcome, ScenarioResult
from cz_gym.evaluation.statistics import Estimate
from cz_gym.units import PERCENT

from .markdown import DRIVES, ERROR, GAPS, Column, gap_of

DIGITS = 6
"""Significant digits of the table's numbers."""
EPISODE_DIGITS = 5
"""Significant digits of an episode's metric, as in episodes.csv."""
HIGH = ("within_half_mm", "mean_pull_within_3pct", "return", "improvement")
"""Metrics of which more is better."""
CONTESTS = ("rmse_mm", "rmse_observable_mm", "max_error_mm", "within_half_mm", "cvar5", "ground_off_pct", "return")
"""Columns whose best is marked: what doing nothing cannot win by itself."""
DISTRIBUTIONS = (ERROR[0], ERROR[1], ERROR[2], DRIVES[1])
"""Metrics whose distribution over the episodes can be looked at."""


class Group(NamedTuple):
    """Columns that belong together."""

    name: str
    columns: tuple[Column, ...]


GROUPS = (
    Group("Error of the true radius", (*ERROR[:4], Column("cvar5", "worst 5 % RMSE [mm]", 3))),
    Group(
        f"Against {REFERENCE} on the same crystals",
        (
            Column("paired", "RMSE less [mm]", 3),
            Column("improvement", "better on [%]", 1, PERCENT),
            Column("paired_step", "pull step RMS less [mm/min]", 4),
        ),
    ),
    Group("Crystal", (ERROR[4], ERROR[5], DRIVES[4])),
    Group("Drives", (*DRIVES[:4], *DRIVES[5:])),
)
"""The table's columns."""


def groups(benchmark: Benchmark) -> tuple[Group, ...]:
    """The columns of this run: without the comparison if the reference took no part, with the gap if there is one."""
    error, against, *others = GROUPS
    if not any(controller.name == REFERENCE for controller in benchmark.controllers):
        return (error, *others)
    if any(outcome.gap for scenario in benchmark.scenarios for outcome in scenario.outcomes):
        against = against._replace(columns=(*against.columns, *GAPS))
    return (error, against, *others)


def columns(benchmark: Benchmark) -> list[dict[str, Any]]:
    """Each column's group, name, unit, decimals, whether more is better and whether its best is marked."""
    found = []
    for group in groups(benchmark):
        for column in group.columns:
            name, _, unit = column.heading.rstrip("]").partition(" [")
            found.append(
                {
                    "group": group.name,
                    "name": name,
                    "unit": unit,
                    "decimals": column.decimals,
                    "more_is_better": column.metric in HIGH,
                    "contest": column.metric in CONTESTS,
                }
            )
    return found


def rows(benchmark: Benchmark, scenario: ScenarioResult) -> list[dict[str, Any]]:
    """One row a controller: how many crystals it met, and each column as [mean, low, high], [mean] or None."""
    shown = [column for group in groups(benchmark) for column in group.columns]
    return [
        {
            "crystals": len(outcome.sample.seeds),
            "cells": [_cell(estimate_of(outcome, column.metric), column) for column in shown],
        }
        for outcome in scenario.outcomes
    ]


def estimate_of(outcome: Outcome, metric: str) -> Estimate | None:
    """What an outcome says in a column; None where there is nothing to say."""
    match metric:
        case "cvar5":
            return outcome.cvar5["rmse_mm"]
        case "improvement":
            return outcome.improvement
        case "paired":
            return outcome.paired.get("rmse_mm")
        case "paired_step":
            return outcome.paired.get("pull_step_rms_mm_per_min")
    for column in GAPS:
        if metric == column.metric:
            return gap_of(outcome, column)
    return outcome.means[metric]


def _cell(estimate: Estimate | None, column: Column) -> list[float] | None:
    if estimate is None:
        return None
    return [rounded(value / column.unit, DIGITS) for value in (estimate.mean, *(estimate.ci95 or ()))]


def distributions(scenario: ScenarioResult) -> list[list[list[float]]]:
    """By controller and metric of :data:`DISTRIBUTIONS`: the episodes' values, one training seed after the other."""
    return [
        [
            [rounded(value / column.unit, EPISODE_DIGITS) for value in outcome.sample.metric(column.metric).ravel()]
            for column in DISTRIBUTIONS
        ]
        for outcome in scenario.outcomes
    ]


def rounded(value: float, digits: int) -> float:
    """The value to that many significant digits."""
    return float(f"{value:.{digits}g}")
