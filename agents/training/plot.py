"""A picture of a run's progress, beside the classical controllers on the same validation crystals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cz_gym.evaluation.report.canvas import COLOURS, INK, canvas, png

from .validation import REFERENCES


def progress(rows: Sequence[dict[str, Any]], title: str) -> bytes:
    """Validation RMSE [mm] against environment steps, the references as lines across, as PNG."""
    figure = canvas(6.4, 3.8)
    axis = figure.subplots()
    steps = [1e-6 * float(row["steps"]) for row in rows]
    errors = [float(row["validation_rmse_mm"]) for row in rows]
    for name, colour in zip(REFERENCES, COLOURS[1:], strict=False):
        rmse = float(rows[-1][f"{name}_rmse_mm"])
        axis.axhline(rmse, color=colour, lw=1.2, label=f"{name} {rmse:.3f}")
    axis.plot(steps, errors, color=COLOURS[0], marker="o", ms=3.5, label=f"{title} {errors[-1]:.3f}")
    for step, error, row in zip(steps, errors, rows, strict=True):
        if lost := float(row["failure_rate"]):
            axis.annotate(f"{lost:.0%} lost", (step, error), (4, 2), textcoords="offset points", fontsize=7, color=INK)
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(lambda value, position: f"{value:g}")
    axis.set_xlabel(f"environment steps [million]; {float(rows[-1]['seconds']) / 60.0:.1f} min so far")
    axis.set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return png(figure)
