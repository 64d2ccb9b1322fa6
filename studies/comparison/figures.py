"""Figures of a comparison: differences to the base as a forest plot, and learning curves."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.ticker import FixedLocator, NullLocator

from cz_gym.agents.training.run_files import REFERENCES
from cz_gym.evaluation.report.canvas import COLOURS, INK, canvas, png, styles

from .results import ACTIVITY, COST, RMSE
from .table import MICRON, Line

PANELS = (
    (RMSE, MICRON, "RMSE of the radius [µm]", 1.0),
    (COST, 1.0, "cost of a step [-]", 0.01),
    (ACTIVITY, MICRON, "pull step RMS [µm/min]", 1.0),
)
"""Of the forest plot: figure, unit, axis, and half width of the axis' middle, which is linear, in the unit."""

AGAINST = (
    ("steps", 1e6, "environment steps [million]"),
    ("seconds", 60.0, "minutes on a core, validation included"),
)
"""What learning curves are drawn against: column of a run's progress, unit, axis."""


def forest(lines: Sequence[Line]) -> bytes:
    """Each variant's paired differences to its base with their intervals, as PNG; left is better."""
    drawn = [line for line in lines if line.cells[RMSE].difference]
    figure = canvas(9.4, 0.3 * len(drawn) + 1.5)
    axes = figure.subplots(1, len(PANELS), sharey=True, squeeze=False)[0]
    for axis, (name, unit, title, middle) in zip(axes, PANELS, strict=True):
        axis.axvline(0.0, color=INK, lw=0.8)
        for place, line in enumerate(drawn):
            if difference := line.cells[name].difference:
                ends = [end / unit for end in difference.ci95 or ()]
                axis.plot(ends, [place] * len(ends), color=COLOURS[1], lw=1.3, solid_capstyle="butt")
                axis.plot([difference.mean / unit], [place], marker="o", color=COLOURS[1], ms=5)
        axis.set_xscale("symlog", linthresh=middle)
        axis.xaxis.set_major_locator(FixedLocator([0.0, *(s * middle * 10.0**k for s in (-1, 1) for k in (0, 2, 4))]))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
        axis.set(xlabel=title, ylim=(len(drawn) - 0.4, -0.6))
    axes[0].set_yticks(range(len(drawn)), [f"{line.name} less {line.base} ({len(line.runs)})" for line in drawn])
    figure.suptitle(
        "Less than zero is better: differences on the same crystals (training seeds), 95 % intervals", fontsize=11
    )
    return png(figure)


def curves(lines: Sequence[Line]) -> bytes:
    """Validation RMSE while learning against steps and minutes, a line a training seed, as PNG.

    Lines across are what classical controllers have on the same crystals; that of the first run with such figures.
    """
    figure = canvas(9.4, 4.6)
    panels = figure.subplots(1, 2, sharey=True)
    for axis, (column, unit, title) in zip(panels, AGAINST, strict=True):
        for line, style in zip(lines, styles([line.name for line in lines]).values(), strict=True):
            for place, run in enumerate(line.runs.values()):
                spent = [row[column] / unit for row in run.validations]
                error = [row["validation_rmse_mm"] for row in run.validations]
                label = line.name if place == 0 and axis is panels[0] else None
                axis.plot(spent, error, color=style.colour, marker=style.marker, ms=2.5, lw=1.0, label=label)
        for name, rmse in _references(lines).items():
            axis.axhline(rmse, color=INK, lw=0.9, ls="--")
            if axis is panels[0]:
                axis.annotate(name, (0.99, rmse), (0, 2), axis.get_yaxis_transform(), textcoords="offset points",
                              ha="right", fontsize=8, color=INK)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=title)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter(lambda value, position: f"{value:g}")
    panels[0].set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle("Radius error on validation crystals while learning: a line a training seed", fontsize=11)
    return png(figure)


def _references(lines: Sequence[Line]) -> dict[str, float]:
    """Validation RMSE of the classical controllers [mm], as the first run that has one says."""
    rows = [run.validations[-1] for line in lines for run in line.runs.values()]
    found = {name: [row[f"{name}_rmse_mm"] for row in rows if f"{name}_rmse_mm" in row] for name in REFERENCES}
    return {name: values[0] for name, values in found.items() if values}
