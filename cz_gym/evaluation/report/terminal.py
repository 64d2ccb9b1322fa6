"""The benchmark's short table for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from cz_gym.evaluation.results import REFERENCE, SPEED, Result
from cz_gym.units import PERCENT

from .tables import FAILURES, HEATER_STEP, PULL_STEP, RMSE, Column, crystals, rows
from .verdict import headline

COLUMNS = (
    Column("max_error_mm", "max [mm]", 2, interval=False),
    Column("within_half_mm", "in 0.5 mm [%]", 1, PERCENT, interval=False),
    PULL_STEP._replace(heading="pull step [mm/min]", interval=False),
    HEATER_STEP._replace(heading="heater step [kW]", interval=False),
    FAILURES._replace(interval=False),
    Column(SPEED, "compute [us/step]", 2),
)
"""Columns without intervals, between RMSE and its paired difference."""
LESS = RMSE._replace(heading=f"RMSE less {REFERENCE}'s [mm]", kind="paired")


def terminal(results: Sequence[Result]) -> str:
    """Return the short table: RMSE with its interval, then means, and the paired difference of RMSE."""
    return "\n\n".join([*map(_scenario, results), headline(results)])


def _scenario(result: Result) -> str:
    columns = (RMSE, *COLUMNS, LESS)
    headings = ["controller", *(column.heading for column in columns)]
    names, units = zip(*(heading.rstrip("]").partition(" [")[::2] for heading in headings), strict=True)
    grid = [names, units, *rows(result, columns)]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    row = result.row
    lines = [
        f"{row.name} ({crystals(len(result.seeds))}){f', on the default puller: {row.puller}' if row.file else ''}"
    ]
    for name, *cells in grid:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([f"  {name:<{widths[0]}}", *padded]).rstrip())
    return "\n".join(lines)
