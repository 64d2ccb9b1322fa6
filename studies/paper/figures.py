"""The paper's figures of data, drawn from our runs in the paper's layout."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cz_gym import make_puller
from cz_gym.baselines.analysis.compensator_design import open_loop
from cz_gym.evaluation.report.canvas import GREY, canvas, png
from cz_gym.physics.linearisation import Floats
from cz_gym.units import MINUTE, MM, MM_PER_MIN

from . import experiments as ex
from .experiments import Trace
from .published import PID

DEGREE = np.pi / 180.0
BLUE, ORANGE, GREEN = "#1f5fa8", "#d1661f", "#2b8a4b"
SHOWN = {
    "r_c": (MM, "radius [mm]"),
    "r_ref": (MM, "radius [mm]"),
    "r_tilde": (MM, r"$\tilde r$ [mm]"),
    "h_c": (MM, "$h_c$ [mm]"),
    "alpha_c": (DEGREE, r"$\alpha_c$ [deg]"),
    "v_p": (MM_PER_MIN, "$v_p$ [mm/min]"),
    "v_g": (MM_PER_MIN, "$v_g$ [mm/min]"),
}
"""The unit in which people read a signal, and what stands at its axis."""


def sheet(rows: int, columns: int, size: tuple[float, float], **grid: Any) -> tuple[Figure, Any]:
    """A figure of that size [in] and its array of axes."""
    figure = canvas(*size)
    return figure, figure.subplots(rows, columns, squeeze=False, **grid)


def label(axis: Any, x: str, y: str, legend: bool = False) -> None:
    """Axis labels, and a legend if wanted."""
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.margins(x=0.01)
    if legend:
        axis.legend(frameon=False, fontsize=8)


def values(run: Trace, name: str) -> Floats:
    """A signal in the unit people read."""
    signal: Floats = run.r_tilde if name == "r_tilde" else getattr(run.signals, name)
    return signal / SHOWN[name][0]


def draw_signal(axis: Any, run: Trace, name: str, x: str, *style: str, **line: Any) -> None:
    """A signal against time, blue by default, with its axes named; ``x`` names the time axis, "" for one below."""
    axis.plot(run.minutes, values(run, name), *style, **({"color": BLUE} | line))
    label(axis, x, SHOWN[name][1])


def ring(run: Trace) -> Floats:
    """The bright ring less the operator's bias [mm]."""
    return (run.signals.r_br - make_puller().ring_bias) / MM


def open_loop_response(model: str) -> Figure:
    """Radius and ring, cone angle, height, growth rate after the pull change; an inset shows the inverse response."""
    run = ex.pull_change(model, before=ex.BEFORE, horizon=1200.0 + ex.BEFORE)
    figure, ((radii, cone), (height, growth)) = sheet(2, 2, (7.2, 4.8), sharex=True)
    draw_signal(radii, run, "r_c", "", label="$r_c$")
    radii.plot(run.minutes, ring(run), color=ORANGE, label="$r_{br}$ - bias")
    radii.legend(frameon=False, fontsize=8, loc="lower right")
    inset = radii.inset_axes((0.16, 0.55, 0.5, 0.42))
    early = (run.t >= ex.BEFORE) & (run.t <= ex.BEFORE + 300.0)
    since = (run.t[early] - ex.BEFORE) / MINUTE
    for signal, color in ((run.signals.r_c, BLUE), (run.signals.r_br, ORANGE)):
        inset.plot(since, (signal[early] - signal[0]) / (MM * MM), color=color)
    inset.axhline(0.0, color=GREY, linewidth=0.7)
    inset.set_ylim(-1.0, 3.0)
    inset.set_title("deviation [µm]", fontsize=7)
    inset.set_xlabel("since the change began [min]", fontsize=7, labelpad=1)
    inset.tick_params(labelsize=7)
    inset.grid(False)
    draw_signal(cone, run, "alpha_c", "")
    draw_signal(height, run, "h_c", "time [min]")
    draw_signal(growth, run, "v_g", "time [min]")
    growth.set_ylim(1.04, 1.24)
    return figure


def _frequency(loop: Any, omega: Floats) -> tuple[Floats, Floats]:
    """Gain [dB] and phase [degrees], the phase unwrapped and near -180 degrees for a loop of the right sign."""
    response = np.asarray(loop(1j * omega))
    phase = np.unwrap(np.angle(response)) / DEGREE
    # The branch is fixed at the highest frequency, where the loop lags by 90 to 270 degrees.
    return 20.0 * np.log10(np.abs(response)), phase - 360.0 * np.round((phase[-1] + 135.0) / 360.0)


def frequency_responses() -> Figure:
    """Bode diagram of both compensated plants with the PID: published functions and our plant."""
    figure, ((gain,), (phase,)) = sheet(2, 1, (6.4, 5.2), sharex=True)
    omega = np.logspace(-5, 0.5, 500)
    for source, name, line in (
        ("own", "our plant", {"linewidth": 3.0, "alpha": 0.45}),
        ("published", "published", {"linewidth": 1.0, "linestyle": "--"}),
    ):
        for model, color in zip(ex.MODELS, (BLUE, ORANGE), strict=True):
            loop = open_loop(ex.linear_model(source, model), ex.compensator(source), PID)
            for axis, curve in zip((gain, phase), _frequency(loop, omega), strict=True):
                axis.semilogx(omega, curve, color=color, label=f"Model {model}, {name}", **line)
    margin = ex.loop_margins("own", "I")
    for axis, level in ((gain, 0.0), (phase, -180.0)):
        axis.axhline(level, color=GREY, linewidth=0.8)
        axis.axvline(margin.crossover, color=GREY, linewidth=0.8, linestyle=":")
    phase.annotate(
        rf"$\omega_c$ = {margin.crossover:.3f} rad/s, $\varphi_m$ = {margin.phase_margin_deg:.0f}° (our Model I)",
        (margin.crossover, -180.0 + margin.phase_margin_deg), (2e-3, -265.0), fontsize=8,
        arrowprops={"arrowstyle": "-", "color": GREY},
    )  # fmt: skip
    label(gain, "", "|L| [dB]", legend=True)
    label(phase, "frequency [rad/s]", "phase of L [deg]")
    return figure


def case_comparison() -> Figure:
    """Cases A and B scaled by 5: compensated measurement, height, cone angle and pull speed, for both models."""
    names = ("r_tilde", "h_c", "alpha_c", "v_p")
    figure, axes = sheet(4, 2, (7.2, 7.4), sharex=True, sharey="row")
    for column, model in zip(axes.T, ex.MODELS, strict=True):
        a, b = ex.cases(model)
        column[0].set_title(f"Model {model}", fontsize=9)
        for axis, name in zip(column, names, strict=True):
            draw_signal(axis, a, name, "time [min]" if name == "v_p" else "", label="case A")
            large, small = values(a, name)[0], values(b, name)
            axis.plot(b.minutes, large + 5.0 * (small - small[0]), "--", color=ORANGE, label="case B, scaled by 5")
            axis.set_ylabel(SHOWN[name][1] if model == "I" else "")
            axis.set_xlim(0.0, 90.0)
        column[0].plot(a.minutes, values(a, "r_ref"), ":", color=GREY, label="reference of case A")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def ramp_temperatures() -> Figure:
    """Heater temperature with its reference, and the melt's, during the ramp (Model I)."""
    run = ex.ramp("I")
    figure, ((heater,), (melt,)) = sheet(2, 1, (6.4, 4.2), sharex=True)
    heater.plot(run.minutes, run.signals.T_1_ref, "--", color=GREY, label="$T_{1,ref}$")
    heater.plot(run.minutes, run.signals.T_1, color=BLUE, label="$T_1$")
    melt.plot(run.minutes, run.signals.T_b, color=ORANGE, label="$T_{bulk}$")
    label(heater, "", "temperature [K]", legend=True)
    label(melt, "time [min]", "temperature [K]", legend=True)
    return figure


def ramp_response(model: str) -> Figure:
    """Closed-loop responses to the ramp in the paper's layout: radii; pull speed, height; growth rate, cone angle."""
    run = ex.ramp(model)
    figure = canvas(7.2, 7.0)
    panels = figure.subplot_mosaic([["r", "r"], ["v_p", "h_c"], ["v_g", "alpha_c"]], sharex=True)
    radii = panels.pop("r")
    draw_signal(radii, run, "r_ref", "time [min]", ":", color=GREY, label="$r_{c,ref}$")
    draw_signal(radii, run, "r_c", "time [min]", label="$r_c$ (true)")
    radii.plot(run.minutes, ring(run), color=ORANGE, linewidth=0.9, label="$r_{br}$ - bias")
    tilde = r"$\tilde r$ (what the controller holds)"
    radii.plot(run.minutes, values(run, "r_tilde"), "--", color=GREEN, label=tilde)
    radii.tick_params(labelbottom=True)
    radii.legend(frameon=False, fontsize=8)
    for name, axis in panels.items():
        draw_signal(axis, run, name, "time [min]" if name in ("v_g", "alpha_c") else "")
    return figure


FIGURES: dict[str, tuple[str, Callable[[], Figure]]] = {
    "figure_02_open_loop_I.png": ("Figure 2: plant at constant power, Model I.", partial(open_loop_response, "I")),
    "figure_03_open_loop_II.png": ("Figure 3: plant at constant power, Model II.", partial(open_loop_response, "II")),
    "figure_09_bode.png": ("Figure 9: compensated loops.", frequency_responses),
    "figure_11_cases.png": ("Figure 11: cases A and B.", case_comparison),
    "figure_12_temperatures.png": (
        "Figure 12: temperatures; Model II's are identical, as the thermal chain does not depend on it.",
        ramp_temperatures,
    ),
    "figure_13_ramp_I.png": ("Figure 13: the ramp, Model I.", partial(ramp_response, "I")),
    "figure_14_ramp_II.png": ("Figure 14: the ramp, Model II.", partial(ramp_response, "II")),
}
"""Captions and functions of the figures by file name, numbered as in the paper."""


def drawn() -> dict[str, bytes]:
    """The figures as PNG by file name."""
    return {name: png(draw()) for name, (_, draw) in FIGURES.items()}
