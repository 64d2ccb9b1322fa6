"""Figures of an agent beside other controllers: answers to events, linear gains, loops, shares of the drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cz_gym.evaluation.report.canvas import GREY, INK, canvas, png, styles
from cz_gym.evaluation.rollout import Floats, Signals
from cz_gym.units import KILO, MINUTE, MM, MM_PER_MIN

from .loop import Responses
from .step_tests import BEGIN, JUMPS, RIPPLE, SPANS, STEP_TESTS

_LINES = ("solid", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (2, 1.2)))
MOVES = ("pull speed less v₀ [mm/min]", "heater less nominal [kW]")
DRIVES = (("pull speed", "mm/min", MM_PER_MIN), ("heater", "kW", KILO))


def looks(names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """How each controller's line is drawn, the same in every figure; the first, the agent, boldest."""
    found: dict[str, dict[str, Any]] = {}
    for i, (name, style) in enumerate(styles(names).items()):
        # The agent without noise has the agent's colour.
        colour = found[names[0]]["color"] if i and name.startswith(f"{names[0]} ") else style.colour
        found[name] = {
            "color": colour,
            "lw": 2.0 if i == 0 else 1.3,
            "ls": _LINES[i % len(_LINES) if i else 0],
            "zorder": 3 - 0.1 * i,
        }
    return found


def _legend(figure: Any, axis: Any) -> None:
    handles, names = axis.get_legend_handles_labels()
    names = [name.replace(" at rest", " at rest (no noise)") for name in names]
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=9)


def response_figure(answers: Mapping[str, Mapping[str, Signals]], dt: float) -> bytes:
    """Radius error and both drives after each event; ``answers`` by step test, then by controller."""
    figure = canvas(12.0, 6.6)
    axes = figure.subplots(3, len(STEP_TESTS), sharex="col", squeeze=False)
    for column, test in zip(axes.T, STEP_TESTS, strict=True):
        style = looks(tuple(answers[test.name]))
        for name, signals in answers[test.name].items():
            minutes = dt * np.arange(1, len(signals.r_c) + 1) / MINUTE
            for axis, values in zip(column, ((signals.r_c - signals.r_ref) / MM, *_moves(signals)), strict=True):
                axis.plot(minutes, values, label=name, **style[name])
        for axis in column:
            axis.axvline(BEGIN / MINUTE, color=GREY, lw=0.7, ls=":")
            axis.margins(x=0.0)
        column[0].set_title(test.title, fontsize=9.5)
        column[-1].set_xlabel("time [min]")
    for axis, label in zip(axes[:, 0], ("radius error [mm]", *MOVES), strict=True):
        axis.set_ylabel(label)
    _legend(figure, axes[0, 0])
    figure.suptitle("One nominal puller, four events; no noise but that of the last", fontsize=11)
    return png(figure)


def _moves(signals: Signals) -> tuple[Floats, Floats]:
    """How far the drives went from where they were, as MOVES says."""
    return (signals.v_p - signals.v_p[0]) / MM_PER_MIN, (signals.Q_H - signals.Q_H[0]) / KILO


def gain_figure(impulses: Mapping[str, Floats], responses: Mapping[str, Responses], dt: float) -> bytes:
    """From the ring to the two drives: after one reading 0.1 mm too large, and over frequency."""
    figure = canvas(9.6, 6.0)
    axes = figure.subplots(2, 2)
    style = looks(tuple(impulses))
    for row, (drive, unit, scale) in enumerate(DRIVES):
        for name, answer in impulses.items():
            seconds = dt * np.arange(len(answer))
            step = answer[:, row] * 0.1 * MM / scale
            axes[row, 0].step(seconds / MINUTE, step, where="post", label=name, **style[name])
            found = responses[name]
            gain = np.abs(found.drives()[:, row]) * MM / scale
            axes[row, 1].loglog(found.omega, gain, label=name, **style[name])
        axes[row, 0].set_ylabel(f"{drive} [{unit}]")
        axes[row, 1].set_ylabel(f"{drive} by ring [{unit} per mm]")
        axes[row, 0].axhline(0.0, color=GREY, lw=0.7)
        axes[row, 0].margins(x=0.0)
    titles = ("one reading 0.1 mm too large, loop closed", "gain over frequency, the controller alone")
    for column, title, label in zip(axes.T, titles, ("time [min]", "angular frequency [rad/s]"), strict=True):
        column[0].set_title(title, fontsize=9.5)
        column[1].set_xlabel(label)
    _legend(figure, axes[0, 0])
    figure.suptitle("From the ring to the drives, small signals under the usual noise", fontsize=11)
    return png(figure)


def loop_figure(responses: Mapping[str, Responses], zero: float) -> bytes:
    """Loop gain and phase at the pull speed, and the sensitivity at the camera; ``zero`` is the plant's [rad/s]."""
    figure = canvas(12.0, 4.2)
    axes = figure.subplots(1, 3)
    style, ends = looks(tuple(responses)), [-180.0]
    for name, found in responses.items():
        at_pull, at_camera = found.opened("v_p"), found.opened("camera")
        axes[0].loglog(found.omega, np.abs(at_pull), label=name, **style[name])
        phase = np.degrees(np.unwrap(np.angle(at_pull)))
        crossing = int(np.argmin(np.abs(np.log(np.abs(at_pull)))))
        phase += 360.0 * np.round((-120.0 - phase[crossing]) / 360.0)
        ends += [float(phase.min()), float(phase.max())]
        axes[1].semilogx(found.omega, phase, **style[name])
        axes[2].loglog(found.omega, 1.0 / np.abs(1.0 + at_camera), **style[name])
    axes[1].set_yticks(np.arange(90.0 * np.floor(min(ends) / 90.0), max(ends) + 90.0, 90.0))
    titles = ("loop gain, opened at the pull speed", "its phase [°]", "sensitivity |1/(1 + L)|, opened at the camera")
    for axis, title, level in zip(axes, titles, (1.0, -180.0, 1.0), strict=True):
        axis.axhline(level, color=GREY, lw=0.8)
        axis.axvline(zero, color=GREY, lw=0.8, ls=":")
        axis.set_title(title, fontsize=9.5)
        axis.set_xlabel("angular frequency [rad/s]")
    axes[0].annotate("right-half-plane zero", (zero, axes[0].get_ylim()[1]), (-3, -4), textcoords="offset points",
                     rotation=90, ha="right", va="top", fontsize=8, color=INK)  # fmt: skip
    _legend(figure, axes[0])
    figure.suptitle("The loop from pull speed to ring and back, small signals under the usual noise", fontsize=11)
    return png(figure)


def jump_figure(jumps: Mapping[str, Sequence[Floats]]) -> bytes:
    """Largest move of the pull speed after a jump of the radius, over the jump; without noise and under it."""
    figure = canvas(9.6, 4.0)
    axes = figure.subplots(1, 2, sharey=True)
    style = looks(tuple(jumps))
    for column, (axis, title) in enumerate(zip(axes, ("without noise", "under the usual noise"), strict=True)):
        for name, gains in jumps.items():
            values = gains[column] * MM / MM_PER_MIN
            axis.semilogx(JUMPS / MM, values, marker="o", ms=3.5, label=name, **style[name])
        axis.set_title(title, fontsize=9.5)
        axis.set_xlabel("jump of the radius [mm]")
        axis.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
    axes[0].set(ylim=(0.0, None), ylabel="pull speed moved [mm/min per mm]")
    _legend(figure, axes[0])
    figure.suptitle("How strongly a jump is answered", fontsize=11)
    return png(figure)


def share_figure(answers: Mapping[str, Signals], responses: Mapping[str, Responses], title: str) -> bytes:
    """How a correction is shared: pull speed against heater after an event, and their ratio over frequency."""
    figure = canvas(9.6, 4.2)
    event, ratio = figure.subplots(1, 2)
    style = looks(tuple(answers))
    for name, signals in answers.items():
        pull, heat = _moves(signals)
        event.plot(pull, heat, label=name, **style[name])
        event.plot(pull[-1], heat[-1], "o", color=style[name]["color"], ms=5, zorder=4)
        drives = np.abs(responses[name].drives())
        ratio.loglog(responses[name].omega, drives[:, 1] / drives[:, 0] * MM_PER_MIN / KILO, **style[name])
    event.axhline(0.0, color=GREY, lw=0.7)
    event.axvline(0.0, color=GREY, lw=0.7)
    event.set(xlabel=MOVES[0], ylabel=MOVES[1])
    event.set_title(f"{title}; a dot is the end", fontsize=9.5)
    ratio.set_xlabel("angular frequency [rad/s]")
    ratio.set_title("heater over pull speed, answer to the ring [kW per mm/min]", fontsize=9.5)
    _legend(figure, event)
    return png(figure)


def ripple_figure(ripples: Mapping[str, Floats]) -> bytes:
    """The pull speed's answer to a ripple of the ring, over the ripple, as time passes."""
    figure = canvas(6.4, 3.8)
    axis = figure.subplots()
    style = looks(tuple(ripples))
    minutes = BEGIN / MINUTE * (np.arange(SPANS) + 0.5)
    for name, gains in ripples.items():
        axis.plot(minutes, gains * MM / MM_PER_MIN, marker="o", ms=3.5, label=name, **style[name])
    axis.set(xlabel="time since the crystal began [min]", ylabel="pull speed moved [mm/min per mm]", ylim=(0.0, None))
    axis.set_title(f"How strongly a ripple of {RIPPLE / MM:g} mm is answered", fontsize=11)
    _legend(figure, axis)
    return png(figure)
