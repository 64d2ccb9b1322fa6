"""Learning curves: validation error against steps and time, beside the classical controllers on the same crystals."""

from collections.abc import Mapping, Sequence
from typing import Any

from cz_gym.evaluation.report.canvas import INK, canvas, png, styles

from .validation import COLUMNS

AXES = (("steps", 1e6, "environment steps [million]"), ("seconds", 60.0, "minutes, validation included"))
"""Horizontal axes: column of a run's progress, unit, label."""


def curves(runs: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> bytes:
    """Validation RMSE [mm] against steps and minutes, a line a run, as PNG; the references are dashed lines across.

    ``runs`` are the rows of ``progress.csv`` of each run, by the name of their agents.
    """
    figure, style = canvas(9.4, 4.6), styles([*runs])
    panels = figure.subplots(1, 2, sharey=True)
    last = next(iter(runs.values()))[0][-1]
    for axis, (column, unit, title) in zip(panels, AXES, strict=True):
        for name, several in runs.items():
            for place, rows in enumerate(several):
                spent, error = ([float(row[each]) for row in rows] for each in (column, "validation_rmse_mm"))
                look = {"color": style[name].colour, "marker": style[name].marker}
                label = name if place == 0 and axis is panels[0] else None
                axis.plot([each / unit for each in spent], error, ms=2.5, lw=1.0, label=label, **look)
        references = {name.removesuffix("_rmse_mm"): float(last[name]) for name in [*last][len(COLUMNS) :]}
        for name, rmse in references.items():
            axis.axhline(rmse, color=INK, lw=0.9, ls="--")
            if axis is panels[0]:
                lowest = rmse == min(references.values())  # lines may be close together
                axis.annotate(name, (0.99, rmse), (0, -2 if lowest else 2), axis.get_yaxis_transform(), color=INK,
                              textcoords="offset points", ha="right", va="top" if lowest else "bottom",
                              fontsize=8)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=title)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter(lambda value, _: f"{value:g}")
    panels[0].set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle("Radius error on validation crystals while learning: a line a training seed", fontsize=11)
    return png(figure)
