"""The benchmark's figures, as PNG bytes; matplotlib's object interface, no display."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cz_gym.evaluation.results import Benchmark, Outcome, ScenarioResult

from .canvas import INK, Style, canvas, png, styles_of
from .crystal import crystal
from .tables import PULL_STEP, RMSE

FAR = 12
"""How many times the least error is not drawn [-]."""
Floats = npt.NDArray[np.float64]


def draw_figures(benchmark: Benchmark) -> dict[str, bytes]:
    """Every figure by file name; a figure with nothing to show is left out."""
    style = styles_of(benchmark.controllers)
    random = [scenario for scenario in benchmark.scenarios if len(scenario.seeds) > 1]
    with rc_context({"text.parse_math": False}):  # a name with dollar signs is no formula
        figures = {"crystal.png": crystal(benchmark.scenarios[0], style)}
        if random:
            figures["errors.png"] = errors(random, style)
            figures["pareto.png"] = pareto(random, style)
    return figures


def _axes(
    figure: Figure, scenarios: Sequence[ScenarioResult], labels: tuple[str, str]
) -> Iterator[tuple[Any, ScenarioResult]]:
    """An axis a scenario, in two columns, logarithmic along x, with labels at the outside."""
    columns = min(len(scenarios), 2)
    axes = figure.subplots(-(-len(scenarios) // columns), columns, sharex=True, sharey=True, squeeze=False)
    for axis in axes[-1]:
        axis.set_xlabel(labels[0])
    for axis in axes[:, 0]:
        axis.set_ylabel(labels[1])
    for axis in axes.flat[len(scenarios) :]:
        axis.set_visible(False)
    for axis, scenario in zip(axes.flat, scenarios, strict=False):
        axis.set_xscale("log")
        axis.tick_params(which="both", labelbottom=True)
        _plain_log(axis.xaxis)
        yield axis, scenario


def errors(scenarios: Sequence[ScenarioResult], style: Mapping[str, Style]) -> bytes:
    """Distribution of RMSE over the episodes: median, quartiles, 5 to 95 %, and the episodes beyond."""
    names = [outcome.controller.name for outcome in scenarios[0].outcomes]
    rows = -(-len(scenarios) // 2)
    figure = canvas(4.6 * min(len(scenarios), 2) + 1.0, rows * (0.36 * len(names) + 1.0) + 0.6)
    for axis, scenario in _axes(figure, scenarios, ("RMSE of the radius [mm]", "")):
        for place, outcome in enumerate(scenario.outcomes):
            _spread(axis, outcome.sample.metric(RMSE.metric).ravel(), place, style[outcome.controller.name].colour)
        axis.set_title(f"{scenario.row.name} ({len(scenario.seeds)} crystals)", fontsize=9.5)
        axis.set_yticks(range(len(names)), names)
        axis.set_ylim(len(names) - 0.4, -0.6)
    figure.suptitle("Radius error by crystal: median, quartiles, 5 to 95 %, crystals beyond", fontsize=11)
    return png(figure)


def _spread(axis: Any, values: Floats, place: int, colour: str) -> None:
    low, first, median, third, high = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95])
    axis.plot([low, high], [place, place], color=colour, lw=1.4, solid_capstyle="butt")
    axis.plot([first, third], [place, place], color=colour, lw=8, solid_capstyle="butt", alpha=0.55)
    axis.plot([median, median], [place - 0.26, place + 0.26], color=INK, lw=1.6)
    beyond = values[(values < low) | (values > high)]
    axis.plot(beyond, np.full(len(beyond), place), ls="none", marker="|", ms=6, mew=0.6, color=colour, alpha=0.7)


def pareto(scenarios: Sequence[ScenarioResult], style: Mapping[str, Style]) -> bytes:
    """Mean RMSE against mean pull step RMS with 95 % intervals, both logarithmic; lower left is better.

    Who has more than :data:`FAR` times the least error is named, not drawn: the others would crowd in a corner. Markers
    are hollow, so that one behind another is seen.
    """
    figure = canvas(4.4 * min(len(scenarios), 2) + 0.8, 2.9 * -(-len(scenarios) // 2) + 1.0)
    moving = [outcome.means[PULL_STEP.metric].mean for scenario in scenarios for outcome in scenario.outcomes]
    floor = min((value for value in moving if value > 0.0), default=1.0) / 3.0
    drawn: set[str] = set()
    for axis, scenario in _axes(figure, scenarios, (PULL_STEP.heading, "RMSE of the radius [mm]")):
        axis.set_yscale("log")
        axis.tick_params(which="both", labelleft=True)
        _plain_log(axis.yaxis, between=True)
        most = FAR * min(outcome.means[RMSE.metric].mean for outcome in scenario.outcomes)
        far = [outcome for outcome in scenario.outcomes if outcome.means[RMSE.metric].mean > most]
        for outcome in scenario.outcomes:
            if outcome not in far:
                drawn.add(outcome.controller.name)
                _point(axis, outcome, style[outcome.controller.name], floor)
        axis.set_title(scenario.row.name, fontsize=9.5)
        if far:
            above = f"more than {FAR} times the least error: " + ", ".join(each.controller.name for each in far)
            axis.text(
                0.5,
                0.995,
                fill(above, 64, break_on_hyphens=False),
                transform=axis.transAxes,
                va="top",
                ha="center",
                fontsize=7,
            )
    handles = [
        Line2D([], [], ls="none", marker=one.marker, color=one.colour, ms=8, mfc="none", mew=1.6, label=name)
        for name, one in style.items()
        if name in drawn
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 5), frameon=False)
    figure.suptitle("Error against pull activity: lower left is better, bars are 95 % intervals", fontsize=11)
    return png(figure)


def _point(axis: Any, outcome: Outcome, style: Style, floor: float) -> None:
    error, activity = outcome.means[RMSE.metric], outcome.means[PULL_STEP.metric]
    x, colour = max(activity.mean, floor), style.colour
    if activity.mean < floor:
        below = {"xytext": (0, -14), "textcoords": "offset points", "ha": "center", "fontsize": 8}
        axis.annotate("← 0", (x, error.mean), color=INK, **below)
    elif activity.ci95:
        axis.plot(activity.ci95, [error.mean] * 2, color=colour, lw=1.2)
    if error.ci95:
        axis.plot([x, x], error.ci95, color=colour, lw=1.2)
    axis.plot(x, error.mean, ls="none", marker=style.marker, ms=8, mfc="none", mew=1.6, color=colour)


def _plain_log(axis: Any, between: bool = False) -> None:
    """Numbers as people write them: powers of ten and, where decades are few, 2 and 5 between them."""

    def two_or_five(value: float, position: int | None) -> str:
        text = f"{value:g}"
        return text if text.strip("0.") in ("2", "5") else ""

    axis.set_major_formatter(lambda value, position: f"{value:g}")
    axis.set_minor_formatter(two_or_five if between else lambda value, position: "")
