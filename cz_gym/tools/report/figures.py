"""The figures of ``report.md`` as PNG: the first crystal under some controllers, and error against pull activity."""

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import LogLocator, NullFormatter

from cz_gym.evaluation.plots import COLUMNS, GREY, INK, DrawnCrystal, canvas, draw, png, styles_of
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.rollout import Floats
from cz_gym.evaluation.statistics import Estimate
from cz_gym.support.units import KILO, MM, MM_PER_MIN
from cz_gym.tools.episodes import Benchmark
from cz_gym.tools.report.task_records import task_of

from .tables import PULL_STEP, RMSE, chosen

FAR = 20
"""Errors beyond this multiple of the least one are not drawn [-]."""
NAMED = 8
"""Most controllers with a colour in :func:`pareto`: with more, points hide each other."""


def draw_figures(benchmark: Benchmark) -> dict[str, bytes]:
    """Draw every figure, by file name; without a random scenario there is only the crystal."""
    random = [case for case in benchmark.cases if len(benchmark.seeds(case)) > 1]
    with rc_context({"text.parse_math": False}):  # a name with dollar signs is no formula
        figures = {"crystal.png": crystal(benchmark, benchmark.cases[0])}
        if random:
            figures["pareto.png"] = pareto(benchmark.only(random))
    return figures


def floor_of(benchmark: Benchmark) -> float:
    """Return the pull step RMS [mm/min] at which to draw controllers that never move the pull speed."""
    names = [each.name for each in benchmark.contenders]
    moving = [benchmark.mean(case, name, PULL_STEP.metric) for case in benchmark.cases for name in names]
    return min((value for value in moving if value > 0.0), default=1.0) / 3.0


def pareto(benchmark: Benchmark) -> bytes:
    """Draw mean RMSE, up to :data:`FAR` times the least, against pull step RMS; the :func:`.chosen` have colours."""
    cases = benchmark.cases
    names = [each.name for each in chosen(benchmark, cases[0], NAMED)]
    floor, style = floor_of(benchmark), styles_of(benchmark.contenders)
    columns = min(len(cases), 2)
    rows = -(-len(cases) // columns)
    figure = canvas(4.5 * columns, 2.9 * rows + 1.2)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axis, case in zip(axes, cases, strict=False):
        _points(axis, benchmark, case, names, floor)
        for numbers in (axis.xaxis, axis.yaxis):
            numbers.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            numbers.set_major_formatter("{x:g}")
            numbers.set_minor_formatter(NullFormatter())
    for axis in axes[len(cases) :]:
        axis.set_visible(False)
    for name in names:
        axes[0].plot([], [], style[name].marker, color=style[name].colour, ms=7, mfc="none", mew=1.6, label=name)
    figure.legend(loc="outside lower center", ncols=2 * columns, frameon=False, fontsize=9)
    figure.suptitle("Error against pull activity: lower left is better, bars are 95 % intervals", fontsize=11)
    return png(figure)


def _points(axis: Any, benchmark: Benchmark, case: Case, names: Sequence[str], floor: float) -> None:
    """Draw a point a controller of a scenario, those of ``names`` with a marker and error bars."""
    style, known = styles_of(benchmark.contenders), [each.name for each in benchmark.contenders]
    axis.set(xscale="log", yscale="log", xlabel=PULL_STEP.heading, ylabel=RMSE.heading)
    axis.tick_params(labelbottom=True, labelleft=True)
    axis.set_title(case.name, fontsize=9.5)
    points = {name: [benchmark.get(case, name, each.metric) for each in (RMSE, PULL_STEP)] for name in known}
    pairs: Any = points.items()
    most = FAR * min((error.mean for _, (error, activity) in pairs if activity.mean > 0.0), default=np.inf)
    for name, (error, activity) in pairs:
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


def _arms(estimate: Estimate) -> list[list[float]]:
    """Lengths of the error bars below and above a mean."""
    low, high = estimate.ends
    return [[estimate.mean - low], [high - estimate.mean]]


# The first crystal of a scenario.


def lost(benchmark: Benchmark, case: Case, name: str) -> bool:
    """Return whether the first crystal was lost, with the first training seed."""
    return bool(benchmark.values(case, name, "failure_rate")[0, 0])


def crystal(benchmark: Benchmark, case: Case) -> bytes:
    """Draw the first crystal of a scenario under the controllers of :func:`.chosen`."""
    if task_of(case).by_length:
        return _by_length(benchmark, case)
    style, crystals = styles_of(benchmark.contenders), []
    for name in (each.name for each in chosen(benchmark, case, COLUMNS)):
        title = f"{fill(name, 18)}\nRMSE {benchmark.values(case, name, RMSE.metric)[0, 0]:.3g} mm"
        signals = benchmark.signals[case.name, name]
        crystals.append(DrawnCrystal(title, signals, style[name].colour, lost(benchmark, case, name)))
    title = f"One crystal of {case.name} (test seed {benchmark.seeds(case)[0]:,})"
    return png(draw(crystals, case.control_interval, title, case.tolerance or 0.0))


class _Panel(NamedTuple):
    label: str
    value: Callable[[Any], Floats]
    reference: Callable[[Any], Floats] | None = None


_PANELS = (
    _Panel("radius error [mm]", lambda s: (s.r_c - s.r_ref) / MM),
    _Panel("pull speed [mm/min]", lambda s: s.v_p / MM_PER_MIN, lambda s: s.v_p_ref / MM_PER_MIN),
    _Panel("heater power [kW]", lambda s: s.Q_H / KILO, lambda s: s.Q_H_ref / KILO),
    _Panel("meniscus height [mm]", lambda s: s.h_c / MM, lambda s: s.h_ref / MM),
    _Panel("v/G, relative", lambda s: s.v_over_G, lambda s: np.ones_like(s.L)),
)
TALLEST, WIDE = 6.0, 8.0
"""Height of the largest profile, and width of the figure [in]."""
POINTS = 2000
"""Most points of a line."""


def _by_length(benchmark: Benchmark, case: Case) -> bytes:
    """Draw a crystal's profile to scale, and its signals by length."""
    names = [each.name for each in chosen(benchmark, case, COLUMNS)]
    style, fate = styles_of(benchmark.contenders), {name: lost(benchmark, case, name) for name in names}
    signals = {name: _thinned(benchmark.signals[case.name, name]) for name in names}
    longest = max(signals.values(), key=lambda s: s.L[-1])
    room = 1.1 * longest.r_ref.max() / MM
    ends = float(longest.L[0] / MM), float(longest.L[-1] / MM)
    tall = min(TALLEST, WIDE / len(names) * (ends[1] - ends[0]) / (2.0 * room) + 0.5)
    figure = canvas(WIDE, tall + 1.15 * len(_PANELS) + 1.0)
    halves: Any = figure.subfigures(2, 1, height_ratios=(tall + 0.3, 1.15 * len(_PANELS)))
    above, below = halves
    profiles = above.subplots(1, len(names), sharex=True, sharey=True, squeeze=False)[0]
    for axis, name in zip(profiles, names, strict=True):
        s, look = signals[name], style[name]
        for side in (-1.0, 1.0):
            axis.plot(side * longest.r_ref / MM, longest.L / MM, color=INK, lw=0.8, ls="--")
        axis.fill_betweenx(s.L / MM, -s.r_c / MM, s.r_c / MM, color=look.colour, alpha=0.45, lw=0)
        axis.set_title(f"{fill(name, 12)}{', lost' * fate[name]}", fontsize=8, color=INK)
        axis.set(aspect="equal", xlim=(-room, room), ylim=ends[::-1])
    profiles[0].set_ylabel("length [mm]")
    profiles[len(names) // 2].set_xlabel("radius [mm]")
    axes: Any = below.subplots(len(_PANELS), 1, sharex=True)
    for axis, panel in zip(axes, _PANELS, strict=True):
        for name in names:
            s = signals[name]
            axis.plot(s.L / MM, panel.value(s), color=style[name].colour, lw=0.9)
        if panel.reference:
            axis.plot(longest.L / MM, panel.reference(longest), color=INK, lw=0.8, ls="--")
        limits = np.concatenate([panel.value(signals[name]) for name in names if not fate[name]] or [np.arange(2.0)])
        low, high = np.quantile(limits, (0.001, 0.999))
        axis.set(xlim=ends, ylim=(low - 0.1 * (high - low), high + 0.1 * (high - low)))
        axis.set_ylabel(panel.label.replace(" [", "\n["))
    axis.set_xlabel("length [mm]")
    figure.suptitle(
        f"One crystal, {case.name} (test seed {benchmark.seeds(case)[0]:,}); dashed: the recipe", fontsize=10.5
    )
    return png(figure)


def _thinned(s: Any) -> Any:
    """The signals at no more than :data:`POINTS` steps."""
    step = -(-len(s.L) // POINTS)
    return type(s)(*(signal[::step] for signal in s))
