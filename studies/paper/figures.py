"""Figures of the paper that show data, drawn from our runs in the paper's layout."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cz_gym import make_puller
from cz_gym.baselines.analysis import open_loop
from cz_gym.evaluation.plots import GREY, RING, TRUE, canvas
from cz_gym.process import Floats
from cz_gym.support.units import MINUTE, MM, MM_PER_MIN

from . import experiments as ex
from .experiments import PID, Trace

DEGREE = np.pi / 180.0
GREEN = "#2b8a4b"
SHOWN = {
    "r_ref": (MM, "radius [mm]", ":", GREY, "reference"),
    "r_c": (MM, "radius [mm]", "-", TRUE, "$r_c$ (true)"),
    "ring": (MM, "radius [mm]", "-", RING, "$r_{br}$ - bias"),
    "r_tilde": (MM, r"$\tilde r$ [mm]", "--", GREEN, r"$\tilde r$ (what the controller holds)"),
    "h_c": (MM, "$h_c$ [mm]", "-", TRUE, ""),
    "alpha_c": (DEGREE, r"$\alpha_c$ [deg]", "-", TRUE, ""),
    "v_p": (MM_PER_MIN, "$v_p$ [mm/min]", "-", TRUE, ""),
    "v_g": (MM_PER_MIN, "$v_g$ [mm/min]", "-", TRUE, ""),
    "T_1_ref": (1.0, "temperature [K]", "--", GREY, "$T_{1,ref}$"),
    "T_1": (1.0, "temperature [K]", "-", TRUE, "$T_1$"),
    "T_b": (1.0, "temperature [K]", "-", RING, "$T_{bulk}$"),
}
"""For each signal: the unit in which people read it, name of its axis, line, colour, and name in a legend."""


def values(run: Trace, name: str) -> Floats:
    """Return a signal in the unit that people read; "ring" is the bright ring less the operator's bias."""
    own = {"r_tilde": run.r_tilde, "ring": run.signals.r_br - make_puller().ring_bias}
    signal: Floats = own[name] if name in own else getattr(run.signals, name)
    return signal / SHOWN[name][0]


def draw(axis: Any, run: Trace, *names: str, legend: bool = False, **line: Any) -> None:
    """Draw signals against time, and the axis of the first named; ``line`` takes precedence over SHOWN."""
    for name in names:
        _, _, style, colour, label = SHOWN[name]
        axis.plot(run.minutes, values(run, name), **({"ls": style, "color": colour, "label": label} | line))
    axis.set_ylabel(SHOWN[names[0]][1])
    axis.margins(x=0.01)
    if legend:
        axis.legend(frameon=False, fontsize=8)


def open_loop_response(model: str) -> Figure:
    """Radius and ring, cone angle, height, growth rate after the pull change; an inset shows the inverse response."""
    run, figure = ex.pull_change(model, before=ex.BEFORE, horizon=1200.0 + ex.BEFORE), canvas(7.2, 4.8)
    radii, cone, height, growth = figure.subplots(2, 2, sharex=True).flat
    draw(radii, run, "r_c", "ring")
    radii.legend(frameon=False, fontsize=8, loc="lower right")
    inset = radii.inset_axes((0.16, 0.55, 0.5, 0.42))
    early = (run.t >= ex.BEFORE) & (run.t <= ex.BEFORE + 300.0)
    for signal, color in ((run.signals.r_c, TRUE), (run.signals.r_br, RING)):
        inset.plot((run.t[early] - ex.BEFORE) / MINUTE, (signal[early] - signal[0]) / (MM * MM), color=color)
    inset.axhline(0.0, color=GREY, linewidth=0.7)
    inset.set_ylim(-1.0, 3.0)
    inset.set_title("deviation [µm]", fontsize=7)
    inset.set_xlabel("since the change began [min]", fontsize=7, labelpad=1)
    inset.tick_params(labelsize=7)
    inset.grid(False)
    for axis, name in ((cone, "alpha_c"), (height, "h_c"), (growth, "v_g")):
        draw(axis, run, name)
    growth.set_ylim(1.04, 1.24)
    figure.supxlabel("time [min]", fontsize=9)
    return figure


def _frequency(loop: Any, omega: Floats) -> tuple[Floats, Floats]:
    """Gain [dB] and phase [degrees], the phase unwrapped and near -180 degrees for a loop of the right sign."""
    response = np.asarray(loop(1j * omega))
    phase = np.unwrap(np.angle(response)) / DEGREE
    # The branch is fixed at the highest frequency, where the loop lags by 90 to 270 degrees.
    return 20.0 * np.log10(np.abs(response)), phase - 360.0 * np.round((phase[-1] + 135.0) / 360.0)


def frequency_responses() -> Figure:
    """Bode diagram of both compensated plants with the PID: published functions and our plant."""
    figure, omega = canvas(6.4, 5.2), np.logspace(-5, 0.5, 500)
    gain, phase = figure.subplots(2, 1, sharex=True)
    for source, name, line in (
        ("own", "our plant", {"linewidth": 3.0, "alpha": 0.45}),
        ("published", "published", {"linewidth": 1.0, "linestyle": "--"}),
    ):
        for model, color in zip(ex.MODELS, (TRUE, RING), strict=True):
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
    gain.set_ylabel("|L| [dB]")
    gain.legend(frameon=False, fontsize=8)
    phase.set(xlabel="frequency [rad/s]", ylabel="phase of L [deg]")
    return figure


def case_comparison() -> Figure:
    """Cases A and B scaled by 5: compensated measurement, height, cone angle and pull speed, for both models."""
    figure = canvas(7.2, 7.4)
    axes = figure.subplots(4, 2, sharex=True, sharey="row")
    for column, model in zip(axes.T, ex.MODELS, strict=True):
        a, b = ex.cases(model)
        column[0].set_title(f"Model {model}", fontsize=9)
        for axis, name in zip(column, ("r_tilde", "h_c", "alpha_c", "v_p"), strict=True):
            draw(axis, a, name, ls="-", color=TRUE, label="case A")
            small = values(b, name)
            scaled = values(a, name)[0] + 5.0 * (small - small[0])
            axis.plot(b.minutes, scaled, "--", color=RING, label="case B, scaled by 5")
            axis.set_xlim(0.0, 90.0)
        column[0].plot(a.minutes, values(a, "r_ref"), ":", color=GREY, label="reference of case A")
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.supxlabel("time [min]", fontsize=9)
    return figure


def ramp_temperatures() -> Figure:
    """Heater temperature with its reference, and the melt's, during the ramp (Model I)."""
    figure = canvas(6.4, 4.2)
    heater, melt = figure.subplots(2, 1, sharex=True)
    draw(heater, ex.ramp("I"), "T_1_ref", "T_1", legend=True)
    draw(melt, ex.ramp("I"), "T_b", legend=True)
    melt.set_xlabel("time [min]")
    return figure


def ramp_response(model: str) -> Figure:
    """Closed-loop responses to the ramp in the paper's layout: radii; pull speed, height; growth rate, cone angle."""
    figure = canvas(7.2, 7.0)
    panels = figure.subplot_mosaic([["r", "r"], ["v_p", "h_c"], ["v_g", "alpha_c"]], sharex=True)
    draw(panels.pop("r"), ex.ramp(model), "r_ref", "r_c", "ring", "r_tilde", legend=True)
    for name, axis in panels.items():
        draw(axis, ex.ramp(model), name)
    figure.supxlabel("time [min]", fontsize=9)
    return figure


FIGURES: dict[str, tuple[str, Callable[[], Figure]]] = {
    "figure_02_open_loop_I.png": ("Figure 2: plant at constant power, Model I.", partial(open_loop_response, "I")),
    "figure_03_open_loop_II.png": ("Figure 3: plant at constant power, Model II.", partial(open_loop_response, "II")),
    "figure_09_bode.png": ("Figure 9: compensated loops.", frequency_responses),
    "figure_11_cases.png": ("Figure 11: cases A and B.", case_comparison),
    "figure_12_temperatures.png": (
        "Figure 12: temperatures, Model I; those of Model II differ by less than 0.1 K.", ramp_temperatures,
    ),
    "figure_13_ramp_I.png": ("Figure 13: the ramp, Model I.", partial(ramp_response, "I")),
    "figure_14_ramp_II.png": ("Figure 14: the ramp, Model II.", partial(ramp_response, "II")),
}  # fmt: skip
"""Captions and functions of the figures by file name, numbered as in the paper."""
