"""The benchmark's short table for a terminal."""

from __future__ import annotations

from collections.abc import Iterable

from cz_gym.evaluation.results import REFERENCE, SPEED, Benchmark, Outcome
from cz_gym.units import PERCENT

from .markdown import NOTHING, Column, interval, label
from .verdict import headline

SHOWN = (
    Column("rmse_mm", "RMSE/mm", 3),
    Column("max_error_mm", "max/mm", 2),
    Column("within_half_mm", "in 0.5 mm/%", 1, PERCENT),
    Column("pull_step_rms_mm_per_min", "pull step/mm/min", 4),
    Column("heater_step_rms_kw", "heater step/kW", 3),
    Column("failure_rate", "failures/%", 1, PERCENT),
    Column(SPEED, "compute/us/step", 2),
)
"""Columns of the terminal's table, heading and unit one above the other."""


def terminal(benchmark: Benchmark) -> str:
    """The short table: RMSE with its interval, then means, and the paired difference of RMSE."""
    headings = [("", "controller"), *_heads(column.heading for column in SHOWN), (f"RMSE less {REFERENCE}'s", "mm")]
    blocks = []
    for scenario in benchmark.scenarios:
        rows = [[label(outcome, scenario), *_cells(outcome)] for outcome in scenario.outcomes]
        grid = [[top for top, _ in headings], [unit for _, unit in headings], *rows]
        widths = [max(len(line[i]) for line in grid) for i in range(len(headings))]
        crystals = len(scenario.seeds)
        lines = [f"{scenario.row.name} ({crystals} crystal{'s' if crystals > 1 else ''})"]
        for name, *cells in grid:
            padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
            lines.append("  ".join([f"  {name:<{widths[0]}}", *padded]).rstrip())
        blocks.append("\n".join(lines))
    return "\n\n".join([*blocks, headline(benchmark)])


def _heads(headings: Iterable[str]) -> list[tuple[str, str]]:
    parts = (heading.split("/", 1) for heading in headings)
    return [(top, unit) for top, unit in parts]


def _cells(outcome: Outcome) -> list[str]:
    rmse, *others = SHOWN
    means = [interval(outcome.means[column.metric]._replace(ci95=None), column) for column in others]
    paired = interval(outcome.paired["rmse_mm"], rmse) if outcome.paired else NOTHING
    return [interval(outcome.means["rmse_mm"], rmse), *means, paired]
