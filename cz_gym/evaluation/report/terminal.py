"""The benchmark's short table for a terminal."""

from __future__ import annotations

from cz_gym.evaluation.results import REFERENCE, SPEED, Benchmark, Outcome, ScenarioResult
from cz_gym.units import PERCENT

from .tables import RMSE, Column, crystals, label
from .verdict import headline

COLUMNS = (
    Column("max_error_mm", "max [mm]", 2),
    Column("within_half_mm", "in 0.5 mm [%]", 1, PERCENT),
    Column("pull_step_rms_mm_per_min", "pull step [mm/min]", 4),
    Column("heater_step_rms_kw", "heater step [kW]", 3),
    Column("failure_rate", "failures [%]", 1, PERCENT),
    Column(SPEED, "compute [us/step]", 2),
)
"""Columns between RMSE and its paired difference, which alone have intervals."""


def terminal(benchmark: Benchmark) -> str:
    """The short table: RMSE with its interval, then means, and the paired difference of RMSE."""
    return "\n\n".join([*(_scenario(scenario) for scenario in benchmark.scenarios), headline(benchmark)])


def _scenario(scenario: ScenarioResult) -> str:
    headings = ["controller", *(column.heading for column in (RMSE, *COLUMNS)), f"RMSE less {REFERENCE}'s [mm]"]
    names, units = zip(*(heading.rstrip("]").partition(" [")[::2] for heading in headings), strict=True)
    grid = [names, units, *((label(outcome, scenario), *_cells(outcome)) for outcome in scenario.outcomes)]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = [f"{scenario.row.name} ({crystals(len(scenario.seeds))})"]
    for name, *cells in grid:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([f"  {name:<{widths[0]}}", *padded]).rstrip())
    return "\n".join(lines)


def _cells(outcome: Outcome) -> list[str]:
    means = [column.text(outcome.means[column.metric]._replace(ci95=None)) for column in COLUMNS]
    return [RMSE.text(RMSE.estimate(outcome)), *means, RMSE.text(outcome.paired.get("rmse_mm"))]
