"""Figures of a comparison: differences to the base as a forest plot, and learning curves."""

from __future__ import annotations

from collections.abc import Sequence

from cz_gym.evaluation.report.canvas import COLOURS, INK, canvas, png, styles

from .results import RMSE
from .table import COLUMNS, Line

LINEAR = {RMSE: 1.0}
"""Half width of the middle of an axis that is linear, in its unit; a hundredth where nothing else is said."""

AGAINST = (
    ("steps", 1e6, "environment steps [million]"),
    ("seconds", 60.0, "minutes on a core, validation included"),
)
"""What learning curves are drawn against: column of a run's progress, unit, axis."""


def forest(lines: Sequence[Line]) -> bytes:
    """Each variant's paired differences to its base with their intervals, as PNG; left is better."""
    drawn = [line for line in lines if line.cells[RMSE].difference]
    figure = canvas(11.0, 0.3 * len(drawn) + 1.5)
    panels = COLUMNS[:3]
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axis, (title, name, unit, _) in zip(axes, panels, strict=True):
        axis.axvline(0.0, color=INK, lw=0.8)
        for place, line in enumerate(drawn):
            if difference := line.cells[name].difference:
                ends = [end / unit for end in difference.ci95 or ()]
                axis.plot(ends, [place] * len(ends), color=COLOURS[1], lw=1.3, solid_capstyle="butt")
                axis.plot([difference.mean / unit], [place], marker="o", color=COLOURS[1], ms=5)
        axis.set_xscale("symlog", linthresh=LINEAR.get(name, 0.01))
        axis.set_xlabel(title)
        axis.set_ylim(len(drawn) - 0.4, -0.6)
    axes[0].set_yticks(range(len(drawn)), [f"{line.name} - {line.base} ({len(line.runs)})" for line in drawn])
    figure.suptitle("Difference to the base on the same crystals, 95 % intervals (training seeds)", fontsize=11)
    return png(figure)


def curves(lines: Sequence[Line]) -> bytes:
    """Validation RMSE while learning against steps and minutes, a line a training seed, as PNG."""
    figure = canvas(10.0, 4.2)
    panels = figure.subplots(1, 2, sharey=True)
    drawn = [line for line in lines if line.trained("steps") is not None]
    for axis, (column, unit, title) in zip(panels, AGAINST, strict=True):
        for line, style in zip(drawn, styles([line.name for line in drawn]).values(), strict=True):
            for place, run in enumerate(line.runs.values()):
                spent = [row[column] / unit for row in run.validations]
                error = [row["validation_rmse_mm"] for row in run.validations]
                label = line.name if place == 0 and axis is panels[0] else None
                axis.plot(spent, error, color=style.colour, marker=style.marker, ms=2.5, lw=1.0, label=label)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel(title)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter(lambda value, position: f"{value:g}")
    panels[0].set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return png(figure)
