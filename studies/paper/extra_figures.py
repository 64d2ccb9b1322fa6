"""Figures the paper does not have: how far the linear model reaches, the washout, camera noise, the exact meniscus."""

from __future__ import annotations

from typing import Any

from cz_gym.units import MINUTE, MM

from .experiments import errors, minutes
from .figures import BLUE, GREEN, GREY, ORANGE, label, sheet
from .numbers import Results


def linear_steps(results: Results) -> Any:
    """Pull-speed steps on the plant and on its linear model, divided by the step's size in per cent."""
    figure, axes = sheet(2, 2, (7.2, 4.8), sharex=True, sharey="row")
    names = ("$r_c$", "$r_{br}$")
    for column, (model, steps) in enumerate(results.steps.items()):
        axes[0, column].set_title(f"Model {model}", fontsize=9)
        for row, name in enumerate(names):
            axis = axes[row, column]
            for step, color in zip(steps, (GREEN, ORANGE), strict=True):
                percent = 100.0 * abs(step.share)
                axis.plot(
                    step.t / MINUTE, step.plant[row] / MM / percent, color=color, label=f"plant, {-percent:.0f} %"
                )
            percent = 100.0 * abs(steps[0].share)
            axis.plot(steps[0].t / MINUTE, steps[0].linear[row] / MM / percent, "--", color=BLUE, label="linear model")
            label(axis, "time [min]" if row else "", f"{name} [mm per % of pull]" if column == 0 else "")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def true_against_compensated(results: Results) -> Any:
    """Errors of the true radius and of the compensated measurement during the ramp."""
    figure, axes = sheet(1, 2, (7.2, 2.9), sharey=True)
    for axis, (model, run) in zip(axes[0], results.ramp.items(), strict=True):
        true, seen = errors(run)
        axis.plot(minutes(run), true / MM, color=BLUE, label="$r_c - r_{c,ref}$: the crystal")
        axis.plot(minutes(run), seen / MM, "--", color=GREEN, label=r"$\tilde r - r_{c,ref}$: what the loop sees")
        axis.plot(minutes(run), (true - seen) / MM, ":", color=ORANGE, label="difference: the washout")
        axis.axhline(0.0, color=GREY, linewidth=0.7)
        axis.set_title(f"Model {model}", fontsize=9)
        label(axis, "time [min]", "error [mm]" if model == "I" else "")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8
    )
    return figure


def cut_off_sweep(results: Results) -> Any:
    """Largest errors in the ramp and phase margin against the high-pass cut-off."""
    figure, axes = sheet(1, 2, (7.2, 3.0))
    frequencies = [found.cut_off for found in results.cut_offs]
    for model, color in (("I", BLUE), ("II", ORANGE)):
        for line, name, text in (("o-", "max_error", "$r_c$"), ("s--", "max_compensated_error", r"$\tilde r$")):
            peaks = [getattr(found, name)[model] / MM for found in results.cut_offs]
            axes[0, 0].semilogx(frequencies, peaks, line, color=color, markersize=3.5, label=f"{text}, Model {model}")
        margin = [found.phase_margin_deg[model] for found in results.cut_offs]
        axes[0, 1].semilogx(frequencies, margin, "o-", color=color, markersize=3.5, label=f"Model {model}")
    for axis in axes[0]:
        axis.axvline(results.own_compensator.slow, color=GREY, linestyle=":", label="paper's cut-off")
    axes[0, 0].set_ylim(0.0, 2.7)
    axes[0, 1].set_ylim(0.0, 90.0)
    label(axes[0, 0], "high-pass cut-off [rad/s]", "largest error in the ramp [mm]")
    axes[0, 0].legend(framealpha=1.0, edgecolor="none", fontsize=7, ncols=2, loc="upper right")
    label(axes[0, 1], "high-pass cut-off [rad/s]", "phase margin [deg]", legend=True)
    return figure


def noise_sweep(results: Results) -> Any:
    """What camera noise does to the printed controller's pull speed."""
    figure, axes = sheet(1, 2, (7.2, 2.8))
    noise = [found.noise / MM for found in results.noise]
    expected = [found.expected_pull_rms_mm_per_min for found in results.noise]
    axes[0, 0].plot(noise, expected, "--", color=GREY, label="noise through K, no limits")
    axes[0, 0].plot(
        noise,
        [found.pull_rms_mm_per_min for found in results.noise],
        "o-",
        color=BLUE,
        label="simulated, 0 to 2.4 mm/min",
    )
    axes[0, 1].plot(noise, [100.0 * found.clipped for found in results.noise], "o-", color=ORANGE)
    axes[0, 1].set_ylim(0.0, 100.0)
    label(axes[0, 0], "camera noise, sd [mm]", "RMS of $v_p - v_0$ [mm/min]", legend=True)
    label(axes[0, 1], "camera noise, sd [mm]", "time at a pull limit [%]")
    for axis in axes[0]:
        axis.set_xlim(0.0, 1.04 * noise[-1])
    return figure


def menisci(results: Results) -> Any:
    """Hurle against the exact meniscus over the crystal's radius."""
    figure, axes = sheet(2, 2, (7.2, 4.8), sharex=True)
    radii = [pair.r_c / MM for pair in results.menisci]
    panels = (
        ("h", MM, "height $h_c$ [mm]"),
        ("slope_rate", -1.0 / MM, r"$-d\alpha_c/dh_c$ [rad/mm]"),
        ("ring_offset", MM, "$r_{br} - r_c$ [mm]"),
        ("zero", 1.0, "zero of $G_m$ [rad/s]"),
    )
    for axis, (name, unit, text) in zip(axes.flat, panels, strict=True):
        axis.plot(
            radii, [getattr(pair.hurle, name) / unit for pair in results.menisci], "o-", color=BLUE, label="Hurle"
        )
        axis.plot(
            radii, [getattr(pair.exact, name) / unit for pair in results.menisci], "s--", color=ORANGE, label="exact"
        )
        label(axis, "crystal radius [mm]" if name in ("ring_offset", "zero") else "", text, legend=name == "h")
    return figure
