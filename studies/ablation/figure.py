"""The ablation as a forest plot: each row's paired difference to the base row, with its interval."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cz_gym.evaluation.report.canvas import COLOURS, GREY, INK, canvas, png

from .rows import BASE
from .table import MICRON, MILLI, SHOWN, Line

PANELS = (
    ("rmse_mm", MICRON, "RMSE of the radius less base's [um]"),
    ("cost", MILLI, "1000 cost, as ppo weighs it, less base's [-]"),
    ("pull_step_rms_mm_per_min", MICRON, "RMS of pull steps less base's [um/min]"),
)
"""Figure, its unit, and the axis's title."""
LINEAR = 1.0
"""Half width of the middle of each axis, in its unit, that is linear; beyond it the axis is logarithmic."""
TICKS = (-100.0, -10.0, -3.0, -1.0, 0.0, 1.0, 3.0, 10.0, 100.0, 1000.0, 10000.0)
STYLES = (
    (SHOWN, "kept", COLOURS[1], "o", -0.18),
    ("last", "last", COLOURS[0], "D", 0.06),
    ("start", "start", GREY, "|", 0.26),
)


def forest(lines: Sequence[Line]) -> bytes:
    """The figure as PNG bytes."""
    shown = [line for line in lines if line.cells[SHOWN, "rmse_mm"].difference is not None] or list(lines)
    figure = canvas(11.0, 0.34 * len(shown) + 1.7)
    axes = figure.subplots(1, len(PANELS), sharey=True, squeeze=False)[0]
    for axis, (name, unit, title) in zip(axes, PANELS, strict=True):
        axis.axvline(0.0, color=INK, lw=0.8)
        for place, line in enumerate(shown):
            _draw(axis, line, name, unit, place)
        axis.set_xscale("symlog", linthresh=LINEAR, linscale=1.0)
        low, high = axis.get_xlim()
        low, high = min(low, -1.5 * LINEAR), max(high, 1.5 * LINEAR)
        axis.set_xticks([tick for tick in TICKS if low <= tick <= high], minor=False)
        axis.set_xticks([], minor=True)
        axis.xaxis.set_major_formatter("{x:g}")
        axis.set_xlim(low, high)
        axis.set_xlabel(title)
        axis.set_ylim(len(shown) - 0.4, -0.6)
    axes[0].set_yticks(range(len(shown)), [f"{line.row.name} ({len(line.seeds)})" for line in shown])
    _legend(figure, axes[0])
    figure.suptitle(
        "One change of PPO() at a time: difference to base on the same crystals (left is better)", fontsize=11
    )
    return png(figure)


def _draw(axis: Any, line: Line, name: str, unit: float, place: int) -> None:
    for stage, _, colour, marker, offset in STYLES:
        cell = line.cells.get((stage, name))
        if cell is None or cell.difference is None or (line.row.name == BASE and stage == SHOWN):
            continue
        mean, ends = cell.difference.mean / unit, [end / unit for end in cell.difference.ci95 or ()]
        if ends:
            axis.plot(ends, [place + offset] * 2, color=colour, lw=1.3, solid_capstyle="butt")
        axis.plot([mean], [place + offset], marker=marker, color=colour, ms=5 if marker != "|" else 8, ls="none")


def _legend(figure: Any, axis: Any) -> None:
    handles = [
        axis.plot([], [], marker=marker, color=colour, lw=1.3, ms=5, label=label)[0]
        for _, label, colour, marker, _ in STYLES
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(STYLES), fontsize=8.5, frameon=False)
