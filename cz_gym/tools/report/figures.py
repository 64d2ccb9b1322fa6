"""The figures of ``report.md``, as PNG bytes."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import LogLocator, NullFormatter

from cz_gym.evaluation.plots import GREY, INK, canvas, chosen, png, styles_of
from cz_gym.evaluation.results import Result
from cz_gym.evaluation.statistics import Estimate

from .crystals import contents_of
from .tables import PULL_STEP, RMSE

FAR = 20
"""Errors beyond this multiple of the least one are not drawn [-]."""
NAMED = 8
"""Most controllers with a colour in :func:`pareto`: with more, points hide each other."""


def draw_figures(results: Sequence[Result]) -> dict[str, bytes]:
    """Draw every figure, by file name; without a random scenario there is only the crystal."""
    random = [result for result in results if len(result.seeds) > 1]
    with rc_context({"text.parse_math": False}):  # a name with dollar signs is no formula
        figures = {"crystal.png": contents_of(results[0].case).picture(results[0])}
        if random:
            figures["pareto.png"] = pareto(random)
    return figures


def floor_of(results: Sequence[Result]) -> float:
    """Return the pull step RMS [mm/min] at which to draw controllers that never move the pull speed."""
    moving = [each[PULL_STEP.metric].mean for result in results for each in result.means.values()]
    return min((value for value in moving if value > 0.0), default=1.0) / 3.0


def pareto(results: Sequence[Result]) -> bytes:
    """Draw mean RMSE, up to :data:`FAR` times the least, against pull step RMS; the :func:`.chosen` have colours."""
    samples = results[0].samples
    names, floor, style = [sample.name for sample in chosen(samples, NAMED)], floor_of(results), styles_of(samples)
    columns = min(len(results), 2)
    rows = -(-len(results) // columns)
    figure = canvas(4.5 * columns, 2.9 * rows + 1.2)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axis, result in zip(axes, results, strict=False):
        axis.set(xscale="log", yscale="log", xlabel=PULL_STEP.heading, ylabel=RMSE.heading)
        axis.tick_params(labelbottom=True, labelleft=True)
        axis.set_title(result.case.name, fontsize=9.5)
        moving = (each for each in result.means.values() if each[PULL_STEP.metric].mean > 0.0)
        most = FAR * min((each[RMSE.metric].mean for each in moving), default=np.inf)
        for name, means in result.means.items():
            error, activity = means[RMSE.metric], means[PULL_STEP.metric]
            x = max(activity.mean, floor)
            if error.mean <= most and name not in names:
                axis.plot(x, error.mean, "o", ms=3, color=GREY, zorder=1)
            elif error.mean <= most:
                look = {"fmt": style[name].marker, "color": style[name].colour, "ms": 7, "mfc": "none", "mew": 1.6}
                spans = {"yerr": _arms(error), "xerr": None if activity.mean < floor else _arms(activity)}
                axis.errorbar(x, error.mean, **spans, **look, elinewidth=1.2)
                if activity.mean < floor:
                    below = {"xytext": (0, -14), "textcoords": "offset points", "ha": "center", "fontsize": 8}
                    axis.annotate("← 0", (x, error.mean), color=INK, **below)
        for numbers in (axis.xaxis, axis.yaxis):
            numbers.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            numbers.set_major_formatter("{x:g}")
            numbers.set_minor_formatter(NullFormatter())
    for axis in axes[len(results) :]:
        axis.set_visible(False)
    for name in names:
        axes[0].plot([], [], style[name].marker, color=style[name].colour, ms=7, mfc="none", mew=1.6, label=name)
    figure.legend(loc="outside lower center", ncols=2 * columns, frameon=False, fontsize=9)
    figure.suptitle("Error against pull activity: lower left is better, bars are 95 % intervals", fontsize=11)
    return png(figure)


def _arms(estimate: Estimate) -> list[list[float]]:
    """Lengths of the error bars below and above a mean."""
    low, high = estimate.ends
    return [[estimate.mean - low], [high - estimate.mean]]
