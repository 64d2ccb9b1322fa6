"""The figures of ``report.md``: the vector pictures, and a typical crystal under some controllers as PNG."""

from collections.abc import Callable
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context

from cz_gym.evaluation.plots import COLUMNS, INK, DrawnCrystal, canvas, draw, png
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.rollout import Floats
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN
from cz_gym.tools.episodes import Benchmark
from cz_gym.tools.report.task_records import task_of

from . import vector
from .tables import RMSE, chosen, looks_of, typical


def draw_figures(benchmark: Benchmark) -> dict[str, bytes]:
    """Draw every figure, by file name, in the order of the report."""
    with rc_context({"text.parse_math": False}):  # a name with dollar signs is no formula
        drawn = crystal(benchmark, benchmark.cases[0])
    pictures = {"result.svg": vector.result(benchmark), "pareto.svg": vector.pareto(benchmark)}
    return {name: vector.as_file(picture) for name, picture in pictures.items()} | {"crystal.png": drawn}


# The typical crystal of a scenario.


def lost(benchmark: Benchmark, case: Case, name: str) -> bool:
    """Return whether the :func:`.typical` crystal was lost, with the first training seed."""
    return bool(benchmark.values(case, name, "failure_rate")[0, typical(benchmark, case)])


def crystal(benchmark: Benchmark, case: Case) -> bytes:
    """Draw the :func:`.typical` crystal of a scenario under the controllers of :func:`.chosen`."""
    if task_of(case).by_length:
        return _by_length(benchmark, case)
    crystals, number = [], typical(benchmark, case)
    for name in (each.name for each in chosen(benchmark, case, COLUMNS)):
        title = f"{fill(name, 18)}\nRMSE {benchmark.values(case, name, RMSE.metric)[0, number]:.3g} mm"
        signals = benchmark.signals[case.name, name]
        crystals.append(DrawnCrystal(title, signals, lost(benchmark, case, name)))
    return png(draw(crystals, case.control_interval, _title(benchmark, case), case.tolerance or 0.0))


def _title(benchmark: Benchmark, case: Case) -> str:
    seeds = benchmark.seeds(case)
    which = "A typical crystal" if len(seeds) > 1 else "The crystal"
    return f"{which} of {case.name} (test seed {seeds[typical(benchmark, case)]:,})"


class _Panel(NamedTuple):
    label: str
    value: Callable[[Any], Floats]
    reference: Callable[[Any], Floats] | None = None
    smooth: bool = False
    """True if moving means are drawn."""

    def line(self, s: Any, window: int) -> Floats:
        """Return the values of a crystal's signals, or their means over ``window`` samples, fewer at the ends."""
        values, flat = self.value(s), np.ones(min(window, len(s.L)))
        if not self.smooth:
            return values
        total, count = (np.convolve(each, flat, "same") for each in (values, np.ones(len(values))))
        return np.divide(total, count)


_PANELS = (
    _Panel("radius error [mm]", lambda s: (s.r_c - s.r_ref) / MM),
    _Panel("pull speed [mm/min]", lambda s: s.v_p / MM_PER_MIN, lambda s: s.v_p_ref / MM_PER_MIN, True),
    _Panel("heater power [kW]", lambda s: s.Q_H / KILO, lambda s: s.Q_H_ref / KILO, True),
    _Panel("meniscus height [mm]", lambda s: s.h_c / MM, lambda s: s.h_ref / MM),
    _Panel("v/G of recipe's [-]", lambda s: s.v_over_G, lambda s: np.ones_like(s.L), True),
)
TALLEST, WIDE = 6.0, 8.0
"""Height of the largest profile, and width of the figure [in]."""
SMOOTH = 5.0 * MINUTE
"""Time over which drives and v/G are averaged [s]."""
POINTS = 2000
"""Most points of a line."""


def _by_length(benchmark: Benchmark, case: Case) -> bytes:
    """Draw a crystal's profile to scale, and its signals by length."""
    names = [each.name for each in chosen(benchmark, case, COLUMNS)]
    style, fate = looks_of(benchmark), {name: lost(benchmark, case, name) for name in names}
    signals: dict[str, Any] = {name: benchmark.signals[case.name, name] for name in names}
    longest = max(signals.values(), key=lambda s: s.L[-1])
    room = 1.1 * longest.r_ref.max() / MM
    ends = float(longest.L[0] / MM), float(longest.L[-1] / MM)
    tall = min(TALLEST, WIDE / len(names) * (ends[1] - ends[0]) / (2.0 * room) + 0.5)
    figure = canvas(WIDE, tall + 1.15 * len(_PANELS) + 1.0)
    halves: Any = figure.subfigures(2, 1, height_ratios=(tall + 0.3, 1.15 * len(_PANELS)))
    above, below = halves
    profiles = above.subplots(1, len(names), sharex=True, sharey=True, squeeze=False)[0]
    for axis, name in zip(profiles, names, strict=True):
        s = signals[name]
        for side in (-1.0, 1.0):
            axis.plot(side * longest.r_ref / MM, longest.L / MM, color=INK, lw=0.8, ls="--")
        axis.fill_betweenx(s.L / MM, -s.r_c / MM, s.r_c / MM, color=style[name].colour, alpha=0.45, lw=0)
        axis.set_title(f"{fill(name, 12)}{', lost' * fate[name]}", fontsize=8, color=INK)
        axis.set(aspect="equal", xlim=(-room, room), ylim=ends[::-1])
    profiles[0].set_ylabel("length [mm]")
    profiles[len(names) // 2].set_xlabel("radius [mm]")
    axes: Any = below.subplots(len(_PANELS), 1, sharex=True)
    for axis, panel in zip(axes, _PANELS, strict=True):
        values = {name: panel.line(s, round(SMOOTH / case.control_interval)) for name, s in signals.items()}
        for name, s in signals.items():
            part = slice(None, None, -(-len(s.L) // POINTS))
            dashes = style[name].dashes
            look: Any = {"color": style[name].colour, "ls": (0, dashes) if dashes else "-"}
            axis.plot(s.L[part] / MM, values[name][part], lw=0.9, **look)
        if panel.reference:
            axis.plot(longest.L / MM, panel.reference(longest), color=INK, lw=0.8, ls="--")
        limits = np.concatenate([values[name] for name in names if not fate[name]] or [np.arange(2.0)])
        low, high = np.quantile(limits, (0.001, 0.999))
        axis.set(xlim=ends, ylim=(low - 0.1 * (high - low), high + 0.1 * (high - low)))
        axis.set_ylabel(panel.label.replace(" [", "\n["))
    axis.set_xlabel("length [mm]")
    figure.suptitle(f"{_title(benchmark, case)}; dashed: the recipe\ndrives and v/G: 5 min means", fontsize=10.5)
    return png(figure)
