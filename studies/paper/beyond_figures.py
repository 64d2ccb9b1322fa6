"""Figures the paper does not have: how far the linear model reaches, the washout, camera noise, the exact meniscus."""

from __future__ import annotations

from matplotlib.figure import Figure

from cz_gym.units import MINUTE, MM

from . import beyond_paper
from .experiments import MODELS, STEPS, compensator, errors, minutes, ramp, step_comparison
from .figures import BLUE, GREEN, GREY, ORANGE, label, sheet


def linear_steps() -> Figure:
    """Pull-speed steps on the plant and on its linear model, divided by the step's size in per cent."""
    figure, axes = sheet(2, 2, (7.2, 4.8), sharex=True, sharey="row")
    for column, model in zip(axes.T, MODELS, strict=True):
        steps = [step_comparison(model, share) for share in STEPS]
        column[0].set_title(f"Model {model}", fontsize=9)
        for row, (axis, name) in enumerate(zip(column, ("$r_c$", "$r_{br}$"), strict=True)):
            for step, color in zip(steps, (GREEN, ORANGE), strict=True):
                percent = 100.0 * abs(step.share)
                deviation = step.plant[row] / MM / percent
                axis.plot(step.t / MINUTE, deviation, color=color, label=f"plant, {-percent:.0f} %")
            first, percent = steps[0], 100.0 * abs(steps[0].share)
            axis.plot(first.t / MINUTE, first.linear[row] / MM / percent, "--", color=BLUE, label="linear model")
            label(axis, "time [min]" if row else "", f"{name} [mm per % of pull]" if model == "I" else "")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def washout() -> Figure:
    """Errors of the true radius and of the compensated measurement during the ramp."""
    figure, axes = sheet(1, 2, (7.2, 2.9), sharey=True)
    for axis, model in zip(axes[0], MODELS, strict=True):
        run = ramp(model)
        true, seen = errors(run)
        axis.plot(minutes(run), true / MM, color=BLUE, label="$r_c - r_{c,ref}$: the crystal")
        axis.plot(minutes(run), seen / MM, "--", color=GREEN, label=r"$\tilde r - r_{c,ref}$: what the loop sees")
        axis.plot(minutes(run), (true - seen) / MM, ":", color=ORANGE, label="difference: the washout")
        axis.axhline(0.0, color=GREY, linewidth=0.7)
        axis.set_title(f"Model {model}", fontsize=9)
        label(axis, "time [min]", "error [mm]" if model == "I" else "")
    lines = axes[0, 0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def cut_off_sweep() -> Figure:
    """Largest errors in the ramp and phase margin against the high-pass cut-off."""
    figure, ((errors_axis, margin_axis),) = sheet(1, 2, (7.2, 3.0))
    at = beyond_paper.CUT_OFFS
    for model, color in (("I", BLUE), ("II", ORANGE)):
        margin, *peaks = zip(*(beyond_paper.cut_off_result(cut_off, model) for cut_off in at), strict=True)
        for line, peak, text in zip(("o-", "s--"), peaks, ("$r_c$", r"$\tilde r$"), strict=True):
            shown = [value / MM for value in peak]
            errors_axis.semilogx(at, shown, line, color=color, markersize=3.5, label=f"{text}, Model {model}")
        margin_axis.semilogx(at, margin, "o-", color=color, markersize=3.5, label=f"Model {model}")
    for axis, top in ((errors_axis, 2.7), (margin_axis, 90.0)):
        axis.axvline(compensator("own").slow, color=GREY, linestyle=":", label="paper's cut-off")
        axis.set_ylim(0.0, top)
    label(errors_axis, "high-pass cut-off [rad/s]", "largest error in the ramp [mm]")
    errors_axis.legend(framealpha=1.0, edgecolor="none", fontsize=7, ncols=2, loc="upper right")
    label(margin_axis, "high-pass cut-off [rad/s]", "phase margin [deg]", legend=True)
    return figure


def noise_sweep() -> Figure:
    """What camera noise does to the printed controller's pull speed."""
    figure, ((pull, limit),) = sheet(1, 2, (7.2, 2.8))
    sweep = [beyond_paper.noise_result(noise) for noise in beyond_paper.NOISES]
    noise = [found.noise / MM for found in sweep]
    expected = [found.expected_pull_rms_mm_per_min for found in sweep]
    simulated = [found.pull_rms_mm_per_min for found in sweep]
    pull.plot(noise, expected, "--", color=GREY, label="noise through K, no limits")
    pull.plot(noise, simulated, "o-", color=BLUE, label="simulated, 0 to 2.4 mm/min")
    limit.plot(noise, [100.0 * found.clipped for found in sweep], "o-", color=ORANGE)
    limit.set_ylim(0.0, 100.0)
    label(pull, "camera noise, sd [mm]", "RMS of $v_p - v_0$ [mm/min]", legend=True)
    label(limit, "camera noise, sd [mm]", "time at a pull limit [%]")
    for axis in (pull, limit):
        axis.set_xlim(0.0, 1.04 * noise[-1])
    return figure


def menisci() -> Figure:
    """Hurle against the exact meniscus over the crystal's radius."""
    figure, axes = sheet(2, 2, (7.2, 4.8), sharex=True)
    at, *menisci = zip(*beyond_paper.compare_menisci(), strict=True)
    radii = [r_c / MM for r_c in at]
    for axis, (name, unit, text) in zip(axes.flat, (
        ("h", MM, "height $h_c$ [mm]"),
        ("slope_rate", -1.0 / MM, r"$-d\alpha_c/dh_c$ [rad/mm]"),
        ("ring_offset", MM, "$r_{br} - r_c$ [mm]"),
        ("zero", 1.0, "zero of $G_m$ [rad/s]"),
    ), strict=True):  # fmt: skip
        for found, who, style, color in zip(menisci, ("Hurle", "exact"), ("o-", "s--"), (BLUE, ORANGE), strict=True):
            axis.plot(radii, [getattr(each, name) / unit for each in found], style, color=color, label=who)
        label(axis, "crystal radius [mm]" if name in ("ring_offset", "zero") else "", text, legend=name == "h")
    return figure
