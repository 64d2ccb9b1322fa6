"""The benchmark's figures, as PNG bytes; matplotlib's object interface, no display."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cz_gym.evaluation.results import Result
from cz_gym.evaluation.rollout import Floats
from cz_gym.evaluation.statistics import Estimate

from .canvas import GREY, INK, Style, canvas, chosen, png, styles_of
from .crystal import crystal
from .tables import PULL_STEP, RMSE

FAR = 20
"""How many times the least error is not drawn [-]."""
FEW_DECADES = 1000.0
"""Up to which ratio of its ends a logarithmic axis has room for more numbers than powers of ten [-]."""
LETTER = 0.085
"""Width of a letter in a legend [in]."""
NAMED = 8
"""Most controllers that :func:`pareto` names: with more, points hide each other and colours are hard to tell apart."""


def draw_figures(results: Sequence[Result]) -> dict[str, bytes]:
    """Draw every figure, by file name; a figure with nothing to show is left out."""
    style = styles_of(results[0].samples)
    random = [result for result in results if len(result.seeds) > 1]
    with rc_context({"text.parse_math": False}):  # a name with dollar signs is no formula
        figures = {"crystal.png": crystal(results[0], style)}
        if random:
            figures["errors.png"] = errors(random, style)
            figures["pareto.png"] = pareto(random, style)
    return figures


def _axes(figure: Figure, results: Sequence[Result], labels: tuple[str, str]) -> Iterator[tuple[Any, Result]]:
    """Yield an axis for each scenario, in two columns, logarithmic along x, with labels at the outside."""
    columns = min(len(results), 2)
    axes = figure.subplots(-(-len(results) // columns), columns, sharex=True, sharey=True, squeeze=False)
    for axis in axes[-1]:
        axis.set_xlabel(labels[0])
    for axis in axes[:, 0]:
        axis.set_ylabel(labels[1])
    for axis in axes.flat[len(results) :]:
        axis.set_visible(False)
    for axis, result in zip(axes.flat, results, strict=False):
        axis.set_xscale("log")
        axis.tick_params(which="both", labelbottom=True)
        _plain_log(axis.xaxis)
        yield axis, result


def errors(results: Sequence[Result], style: Mapping[str, Style]) -> bytes:
    """Draw the distribution of RMSE over the episodes: median, quartiles, 5 to 95 %, and the episodes beyond."""
    names = [sample.name for sample in results[0].samples]
    rows = -(-len(results) // 2)
    figure = canvas(4.6 * min(len(results), 2) + 1.0, rows * (0.36 * len(names) + 1.0) + 0.6)
    for axis, result in _axes(figure, results, ("RMSE of the radius [mm]", "")):
        for place, sample in enumerate(result.samples):
            _spread(axis, sample.metric(RMSE.metric).ravel(), place, style[sample.name].colour)
        axis.set_title(f"{result.row.name} ({len(result.seeds)} crystals)", fontsize=9.5)
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


def floor_of(results: Sequence[Result]) -> float:
    """Return the pull step RMS at which controllers stand that never move the pull speed [mm/min]."""
    moving = [each[PULL_STEP.metric].mean for result in results for each in result.means.values()]
    return min((value for value in moving if value > 0.0), default=1.0) / 3.0


def pareto(results: Sequence[Result], style: Mapping[str, Style]) -> bytes:
    """Draw mean RMSE against mean pull step RMS with 95 % intervals, both logarithmic; lower left is better.

    Some controllers are :func:`named`, by hollow markers, so that one behind another is seen; the others are grey
    dots. Who has more than :data:`FAR` times the least error of those that move the pull speed is listed, not drawn.
    """
    names, floor = named(results), floor_of(results)
    figure = canvas(9.0 if len(results) > 1 else 6.8, max(2.9 * -(-len(results) // 2) + 1.0, 4.6))
    for axis, result in _axes(figure, results, (PULL_STEP.heading, "RMSE of the radius [mm]")):
        axis.set_yscale("log")
        axis.tick_params(which="both", labelleft=True)
        _plain_log(axis.yaxis)
        least = [each[RMSE.metric].mean for each in result.means.values() if each[PULL_STEP.metric].mean > 0.0]
        most = FAR * min(least, default=np.inf)
        far = [name for name, each in result.means.items() if each[RMSE.metric].mean > most]
        for name in (name for name in result.means if name not in far):
            _point(axis, result.means[name], style[name] if name in names else None, floor)
        axis.set_title(result.row.name, fontsize=9.5)
        if far:
            place = {"transform": axis.transAxes, "va": "top", "ha": "right", "fontsize": 8}
            axis.text(0.995, 0.995, fill(f"above the picture: {', '.join(far)}", 50, break_on_hyphens=False), **place)
    handles = [
        Line2D([], [], ls="none", marker=one.marker, color=one.colour, ms=7, mfc="none", mew=1.6, label=name)
        for name, one in style.items()
        if name in names
    ]
    if len(names) < len(results[0].samples):
        handles.append(Line2D([], [], ls="none", marker="o", color=GREY, ms=3, label="others"))
    columns = int(figure.get_figwidth() / (0.6 + LETTER * max(len(name) for name in names)))
    figure.legend(handles=handles, loc="outside lower center", ncols=max(columns, 1), frameon=False, fontsize=9)
    figure.suptitle("Error against pull activity: lower left is better, bars are 95 % intervals", fontsize=11)
    return png(figure)


def named(results: Sequence[Result]) -> list[str]:
    """Return who is named: the best classical controller of each scenario, and chosen others of the first."""
    best = sorted({result.rival for result in results if result.rival})
    others = [sample for sample in results[0].samples if sample.name not in best]
    return [*best, *(sample.name for sample in chosen(others, NAMED - len(best)))]


def _point(axis: Any, means: Mapping[str, Estimate], style: Style | None, floor: float) -> None:
    """Draw a marker with its intervals in that style, or a grey dot."""
    error, activity = means[RMSE.metric], means[PULL_STEP.metric]
    x = max(activity.mean, floor)
    if style is None:
        axis.plot(x, error.mean, ls="none", marker="o", ms=3, color=GREY, zorder=1)
        return
    if activity.mean < floor:
        below = {"xytext": (0, -14), "textcoords": "offset points", "ha": "center", "fontsize": 8}
        axis.annotate("← 0", (x, error.mean), color=INK, **below)
    elif activity.ci95:
        axis.plot(activity.ci95, [error.mean] * 2, color=style.colour, lw=1.2)
    if error.ci95:
        axis.plot([x, x], error.ci95, color=style.colour, lw=1.2)
    axis.plot(x, error.mean, ls="none", marker=style.marker, ms=7, mfc="none", mew=1.6, color=style.colour)


def _plain_log(axis: Any) -> None:
    """Numbers as people write them: powers of ten and, where decades are few, 2 and 5 between them."""

    def two_or_five(value: float, position: int | None) -> str:
        text, (low, high) = f"{value:g}", axis.get_view_interval()
        return text if text.strip("0.") in ("2", "5") and high < FEW_DECADES * low else ""

    axis.set_major_formatter(lambda value, position: f"{value:g}")
    axis.set_minor_formatter(two_or_five)
