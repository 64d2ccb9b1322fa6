"""Figures of an agent beside other controllers: answers to events, jumps and ripples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cz_gym.evaluation.report.canvas import GREY, canvas, png, styles
from cz_gym.evaluation.rollout import Floats, Signals
from cz_gym.units import KILO, MINUTE, MM, MM_PER_MIN

from .step_tests import BEGIN, JUMPS, RIPPLE, SPANS, StepTest, control_interval

_LINES = ("solid", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (2, 1.2)))


def looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """How each controller's line is drawn; the first, the agent, is the boldest."""
    return {
        name: {"color": style.colour, "lw": 1.3 if i else 2.0, "ls": _LINES[i % len(_LINES)], "zorder": 3 - 0.1 * i,
               "label": name}
        for i, (name, style) in enumerate(styles(names).items())
    }  # fmt: skip


def _finished(figure: Any, title: str) -> bytes:
    """The figure as PNG, with a title and one legend, that of its first panel."""
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    return png(figure)


def response_figure(answers: Mapping[StepTest, Mapping[str, Signals]]) -> bytes:
    """Radius error and both drives after each event."""
    figure = canvas(12.0, 6.6)
    axes = figure.subplots(3, len(answers), sharex="col", squeeze=False)
    for column, (test, by_name) in zip(axes.T, answers.items(), strict=True):
        for name, look in looks(tuple(by_name)).items():
            s = by_name[name]
            minutes = control_interval() * np.arange(1, len(s.r_c) + 1) / MINUTE
            moves = (s.v_p - s.v_p[0]) / MM_PER_MIN, (s.Q_H - s.Q_H[0]) / KILO
            for axis, values in zip(column, ((s.r_c - s.r_ref) / MM, *moves), strict=True):
                axis.plot(minutes, values, **look)
        for axis in column:
            axis.axvline(BEGIN / MINUTE, color=GREY, lw=0.7, ls=":")
            axis.margins(x=0.0)
        column[0].set_title(test.title, fontsize=9.5)
        column[-1].set_xlabel("time [min]")
    labels = ("radius error [mm]", "pull speed less v₀ [mm/min]", "heater less nominal [kW]")
    for axis, label in zip(axes[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    return _finished(figure, "One nominal puller, four events; no noise but that of the last")


def jump_figure(jumps: Mapping[str, Mapping[str, Floats]]) -> bytes:
    """Largest move of the pull speed per jump of the radius, without noise and under it."""
    figure = canvas(9.6, 4.0)
    axes = figure.subplots(1, 2, sharey=True)
    titles = {"none": "without noise", "usual": "under the usual noise"}
    for axis, (noise, title) in zip(axes, titles.items(), strict=True):
        for name, look in looks(tuple(jumps)).items():
            axis.semilogx(JUMPS / MM, jumps[name][noise] * MM / MM_PER_MIN, marker="o", ms=3.5, **look)
        axis.set_title(title, fontsize=9.5)
        axis.set_xlabel("jump of the radius [mm]")
        axis.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
    axes[0].set(ylim=(0.0, None), ylabel="pull speed moved [mm/min per mm]")
    return _finished(figure, "How strongly a jump is answered")


def ripple_figure(ripples: Mapping[str, Floats]) -> bytes:
    """The pull speed's answer per ripple of the ring, as time passes."""
    figure = canvas(6.4, 3.8)
    axis = figure.subplots()
    minutes = BEGIN / MINUTE * (np.arange(SPANS) + 0.5)
    for name, look in looks(tuple(ripples)).items():
        axis.plot(minutes, ripples[name] * MM / MM_PER_MIN, marker="o", ms=3.5, **look)
    axis.set(xlabel="time since the crystal began [min]", ylabel="pull speed moved [mm/min per mm]", ylim=(0.0, None))
    return _finished(figure, f"How strongly a ripple of {RIPPLE / MM:g} mm is answered")
