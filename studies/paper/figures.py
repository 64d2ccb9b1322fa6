"""The paper's data figures, drawn from our runs in the paper's layout."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym import make_puller
from cz_gym.baselines.analysis.compensator_design import open_loop
from cz_gym.baselines.pid.compensated_pid import Compensator
from cz_gym.physics.linearisation import RadiusModel
from cz_gym.units import MINUTE, MM, MM_PER_MIN

from .experiments import Trace, minutes
from .numbers import BEFORE, PUBLISHED, Results
from .published import PID

DEGREE = np.pi / 180.0
BLUE, ORANGE, GREEN, GREY = "#1f5fa8", "#d1661f", "#2b8a4b", "#777777"
STYLE = {
    "font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False,
    "lines.linewidth": 1.4, "legend.frameon": False, "legend.fontsize": 8, "axes.formatter.useoffset": False,
}  # fmt: skip
RADII, PULL, HEIGHT, GROWTH, CONE = (
    "radius [mm]",
    "$v_p$ [mm/min]",
    "$h_c$ [mm]",
    "$v_g$ [mm/min]",
    r"$\alpha_c$ [deg]",
)


def sheet(rows: int, columns: int, size: tuple[float, float], **grid: Any) -> tuple[Any, Any]:
    """A figure and its array of axes."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **grid)
    return figure, axes


def label(axis: Any, x: str, y: str, legend: bool = False) -> None:
    """Axis labels, and a legend if asked for."""
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.margins(x=0.01)
    if legend:
        axis.legend(frameon=False, fontsize=8)


def _shown(run: Trace, name: str) -> npt.NDArray[np.float64]:
    """A signal in the unit people read."""
    unit = {"v_p": MM_PER_MIN, "v_g": MM_PER_MIN, "alpha_c": DEGREE}.get(name, MM)
    values: npt.NDArray[np.float64] = getattr(run.signals, name) / unit
    return values


def pull_profile(results: Results) -> Any:
    """Pull speed of the open-loop experiment."""
    figure, axes = sheet(1, 1, (5.0, 2.4))
    run = results.open_loop["I"]
    axes[0, 0].step(minutes(run)[1:], _shown(run, "v_p")[1:], color=BLUE)
    axes[0, 0].set_ylim(1.05, 1.23)
    label(axes[0, 0], "time [min]", PULL)
    return figure


def open_loop_response(results: Results, model: str) -> Any:
    """Radius and ring, cone angle, height, growth rate after the pull change; an inset shows the inverse response."""
    run = results.open_loop[model]
    t, s = minutes(run), run.signals
    ring = (s.r_br - make_puller().ring_bias) / MM
    figure, axes = sheet(2, 2, (7.2, 4.8), sharex=True)
    axes[0, 0].plot(t, _shown(run, "r_c"), color=BLUE, label="$r_c$")
    axes[0, 0].plot(t, ring, color=ORANGE, label="$r_{br}$ - bias")
    label(axes[0, 0], "", RADII)
    axes[0, 0].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(0.03, 0.32))
    inset = axes[0, 0].inset_axes((0.16, 0.55, 0.5, 0.42))
    early = (run.t >= BEFORE) & (run.t <= BEFORE + 300.0)
    since = (run.t[early] - BEFORE) / MINUTE
    inset.plot(since, (s.r_c[early] - s.r_c[0]) / (MM * MM), color=BLUE)
    inset.plot(since, (s.r_br[early] - s.r_br[0]) / (MM * MM), color=ORANGE)
    inset.axhline(0.0, color=GREY, linewidth=0.7)
    inset.set_ylim(-1.0, 3.0)
    inset.set_title("deviation [µm]", fontsize=7)
    inset.set_xlabel("since the change began [min]", fontsize=7, labelpad=1)
    inset.tick_params(labelsize=7)
    inset.grid(False)
    for axis, name, text in ((axes[0, 1], "alpha_c", CONE), (axes[1, 0], "h_c", HEIGHT), (axes[1, 1], "v_g", GROWTH)):
        axis.plot(t, _shown(run, name), color=BLUE)
        label(axis, "time [min]" if axis is not axes[0, 1] else "", text)
    axes[1, 1].set_ylim(1.04, 1.24)
    return figure


def _frequency(loop: Any, omega: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Gain [dB] and phase [degrees], the phase unwrapped and near -180 degrees for a loop of the right sign."""
    response = np.asarray(loop(1j * omega))
    phase = np.unwrap(np.angle(response)) / DEGREE
    # The branch is fixed at the highest frequency, where the loop lags by 90 to 270 degrees.
    return 20.0 * np.log10(np.abs(response)), phase - 360.0 * np.round((phase[-1] + 135.0) / 360.0)


def _bode(results: Results, omega: npt.NDArray[np.float64], compensated: bool) -> tuple[Any, Any]:
    """Bode diagram of both models, published functions and our plant, with or without their compensators."""
    figure, axes = sheet(2, 1, (6.4, 5.2), sharex=True)
    sources: tuple[tuple[str, dict[str, RadiusModel], Compensator, dict[str, Any]], ...] = (
        ("our plant", results.models, results.own_compensator, {"linewidth": 3.0, "alpha": 0.45}),
        ("published", PUBLISHED, results.published_compensator, {"linewidth": 1.0, "linestyle": "--"}),
    )
    for name, models, compensator, line in sources:
        for (model, functions), color in zip(models.items(), (BLUE, ORANGE), strict=True):
            loop = open_loop(functions, compensator if compensated else None, PID)
            for axis, values in zip(axes[:, 0], _frequency(loop, omega), strict=True):
                axis.semilogx(omega, values, color=color, label=f"Model {model}, {name}", **line)
    axes[0, 0].axhline(0.0, color=GREY, linewidth=0.8)
    axes[1, 0].axhline(-180.0, color=GREY, linewidth=0.8)
    return figure, axes[:, 0]


def frequency_responses(results: Results) -> Any:
    """Bode diagram of both compensated plants with the PID: published functions and our plant."""
    figure, axes = _bode(results, np.logspace(-5, 0.5, 500), compensated=True)
    margin = results.margins["own_I"]
    for axis in axes:
        axis.axvline(margin.crossover, color=GREY, linewidth=0.8, linestyle=":")
    axes[1].annotate(
        rf"$\omega_c$ = {margin.crossover:.3f} rad/s, $\varphi_m$ = {margin.phase_margin_deg:.0f}° (our Model I)",
        (margin.crossover, -180.0 + margin.phase_margin_deg), (2e-3, -265.0), fontsize=8,
        arrowprops={"arrowstyle": "-", "color": GREY},
    )  # fmt: skip
    label(axes[0], "", "|L| [dB]", legend=True)
    label(axes[1], "frequency [rad/s]", "phase of L [deg]")
    return figure


def margin_sketch(results: Results) -> Any:
    """The paper's sketch of a Bode diagram with a right half plane zero, drawn with the uncompensated plant itself."""
    omega = np.logspace(-5, 0.5, 500)
    figure, axes = _bode(results, omega, compensated=False)
    model = results.models["I"]
    for axis in axes:
        axis.axvspan(2.0 * model.poles[0], 0.5 * model.zero, color=GREY, alpha=0.15, label="room for the crossover")
        axis.axvline(model.zero, color="black", linestyle=":", linewidth=1.0, label="right half plane zero")
    axes[0].set_xlim(omega[0], omega[-1])
    label(axes[0], "", "|L| [dB]", legend=True)
    label(axes[1], "frequency [rad/s]", "phase of L [deg]")
    return figure


def case_comparison(results: Results) -> Any:
    """Cases A and B scaled by 5: compensated measurement, height, cone angle and pull speed, for both models."""
    rows: Iterable[tuple[str, str]] = (
        ("r_tilde", r"$\tilde r$ [mm]"),
        ("h_c", HEIGHT),
        ("alpha_c", CONE),
        ("v_p", PULL),
    )
    figure, axes = sheet(4, 2, (7.2, 7.4), sharex=True, sharey="row")
    for column, (model, (a, b)) in enumerate(results.cases.items()):
        axes[0, column].set_title(f"Model {model}", fontsize=9)
        for axis, (name, text) in zip(axes[:, column], rows, strict=True):
            large, small = ((run.r_tilde / MM if name == "r_tilde" else _shown(run, name)) for run in (a, b))
            axis.plot(minutes(a), large, color=BLUE, label="case A")
            axis.plot(minutes(b), large[0] + 5.0 * (small - small[0]), "--", color=ORANGE, label="case B, scaled by 5")
            label(axis, "time [min]" if name == "v_p" else "", text if column == 0 else "")
            axis.set_xlim(0.0, 90.0)
    axes[0, 0].plot(minutes(results.cases["I"][0]), _shown(results.cases["I"][0], "r_ref"), ":", color=GREY)
    axes[0, 0].plot([], [], ":", color=GREY, label="reference of case A")
    axes[0, 1].plot(minutes(results.cases["II"][0]), _shown(results.cases["II"][0], "r_ref"), ":", color=GREY)
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def ramp_temperatures(results: Results) -> Any:
    """Heater temperature with its reference, and the melt's, during the ramp (Model I)."""
    run = results.ramp["I"]
    figure, axes = sheet(2, 1, (6.4, 4.2), sharex=True)
    axes[0, 0].plot(minutes(run), run.signals.T_1_ref, "--", color=GREY, label="$T_{1,ref}$")
    axes[0, 0].plot(minutes(run), run.signals.T_1, color=BLUE, label="$T_1$")
    axes[1, 0].plot(minutes(run), run.signals.T_b, color=ORANGE, label="$T_{bulk}$")
    label(axes[0, 0], "", "temperature [K]", legend=True)
    label(axes[1, 0], "time [min]", "temperature [K]", legend=True)
    return figure


def ramp_response(results: Results, model: str) -> Any:
    """Closed-loop responses to the ramp in the paper's layout: radii; pull speed, height; growth rate, cone angle."""
    import matplotlib

    run = results.ramp[model]
    t = minutes(run)
    figure = sheet(1, 1, (7.2, 7.0))[0]
    figure.clear()
    with matplotlib.rc_context(STYLE):
        panels = figure.subplot_mosaic([["r", "r"], ["v_p", "h_c"], ["v_g", "alpha_c"]], sharex=True)
    ring = (run.signals.r_br - make_puller().ring_bias) / MM
    radii = panels["r"]
    radii.plot(t, _shown(run, "r_ref"), ":", color=GREY, label="$r_{c,ref}$")
    radii.plot(t, _shown(run, "r_c"), color=BLUE, label="$r_c$ (true)")
    radii.plot(t, ring, color=ORANGE, linewidth=0.9, label="$r_{br}$ - bias")
    radii.plot(t, run.r_tilde / MM, "--", color=GREEN, label=r"$\tilde r$ (what the controller holds)")
    radii.tick_params(labelbottom=True)
    label(radii, "time [min]", RADII, legend=True)
    for name, text in (("v_p", PULL), ("h_c", HEIGHT), ("v_g", GROWTH), ("alpha_c", CONE)):
        panels[name].plot(t, _shown(run, name), color=BLUE)
        label(panels[name], "time [min]" if name in ("v_g", "alpha_c") else "", text)
    return figure
