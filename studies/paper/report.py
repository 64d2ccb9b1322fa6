"""The report: sections, figures and tables, in Markdown."""

from __future__ import annotations

import numpy as np

from cz_gym.units import MM

from .experiments import INTERVAL
from .numbers import Results, cycle_numbers, ramp_numbers
from .published import CROSSOVER, PHASE_MARGIN_DEG, PID
from .report_beyond import beyond, meniscus, shown, table
from .rows import as_markdown, rows


def report(results: Results) -> str:
    """The whole report."""
    sections = (_opening, _open_loop, _linear, _compensator, _pid, _closed_loop, beyond, meniscus)
    return "\n\n".join(section(results) for section in sections) + "\n"


def _opening(r: Results) -> str:
    ramp, cases = ramp_numbers(r.ramp["I"]), r.case_difference
    published = r.margins["published_I"], r.margins["published_II"]
    worst = max(max(found) for found in cases.values())
    return f"""# Part II, redone on our plant

Every value that Bukhari, Hovd and Winkler print in Part II beside what our plant, or the paper's own functions, give.
Written by `python -m studies.paper`: the printed values stand in `studies/paper/published.py`, all others are
computed; the explanations and reasons were written for these. `docs/paper.md` says what each step means.

- The plant's linear model agrees with the paper's Model II; Model I's G_p and G_m differ by a factor that cancels
  in their product.
- The design procedure returns the printed compensator: {r.published_compensator.gain:.5f} from the published functions,
  {r.own_compensator.gain:.5f} from our plant.
- The printed crossover ({CROSSOVER} rad/s) and phase margin ({PHASE_MARGIN_DEG:.0f} degrees) **do not follow from the
  paper's own functions and Table 1**: those give {published[0].crossover:.4f} rad/s and
  {published[0].phase_margin_deg:.1f} degrees (I), {published[1].crossover:.4f} rad/s and
  {published[1].phase_margin_deg:.1f} degrees (II).
- Cases A and B scaled by 5 differ by at most {100 * worst:.1f} % of the largest deviation of any signal.
- In the temperature ramp the true radius is off by up to {ramp["max_error_mm"]:.2f} mm while the compensated
  measurement shows {ramp["max_compensated_error_mm"]:.2f} mm.

## Published beside computed

A dash means that the paper gives no number.

{as_markdown(rows(r))}"""


def _open_loop(r: Results) -> str:
    return f"""## 1. Open loop

The pull speed falls by 10 % along the quintic 10 s^3 - 15 s^4 + 6 s^5 over 600 s, the heater at nominal power. The
paper shows its profile without numbers, so the shapes can be compared and not the values. The crystal thickens at
once; the ring first shows it thinner, by {1e3 * r.inverse["I"].depth / MM:.2f} µm (I) and
{1e3 * r.inverse["II"].depth / MM:.2f} µm (II), and is back after {r.inverse["I"].recovery:.0f} s and
{r.inverse["II"].recovery:.0f} s. The dip is small because the change is slow against the zero: a sudden change of the
same size gives {1e3 * r.inverse_step["I"].depth / MM:.1f} µm and {r.inverse_step["I"].recovery:.0f} s (I).
In Model II the growth rate is constant, in Model I it falls with the meniscus, which slows the widening.

{shown("figure_01", "figure_02", "figure_03")}"""


def _linear(r: Results) -> str:
    lines = []
    for model, steps in r.steps.items():
        for step in steps:
            gaps = " | ".join(f"{100 * step.worst(output):.2f} %" for output in (0, 1))
            lines.append(f"| {model} | {100 * step.share:.0f} % | {gaps} |")
    functions = []
    for model, m in r.models.items():
        poles = ", ".join(f"{pole:.4g}" for pole in m.poles)
        functions.append(
            f"| {model} | {m.numerator:.7f} | {poles} | {m.lead:.4f} s + {m.constant:.4f} | {m.zero:.5f} | "
            f"{m.numerator * m.constant:.7f} |"
        )
    head = "| model | numerator of G_p [1/s] | poles [rad/s] | G_m | zero [rad/s] | gain, numerator x constant [1/s] |"
    return f"""## 2. Linearisation

Derivatives by complex step through the functions that are simulated; melt temperature held, as in the paper.

{table(head, functions)}

Largest difference between plant and linear model over 10 min after a pull-speed step, relative to the largest
deviation. The ring is the less linear of the two, its offset bending with the height of the meniscus:

{table("| model | step | r_c | r_br |", lines)}

{shown("figure_04", "extra_a")}"""


def _compensator(r: Results) -> str:
    found = r.own_compensator
    return f"""## 3. Compensator

Ideal compensator G_p (1 - G_m), high-pass filter 5000 s/(5000 s + 1), stable part by ordered Schur form and Sylvester
equation, constant of the numerator removed. From the published functions of Model I:

    G_pc,real(s) = {r.published_compensator.gain:.5f} s / ((s + {r.published_compensator.fast:.4g}) (s + \
{r.published_compensator.slow:.4g}))

and from our plant {found.gain:.5f} s / ((s + {found.fast:.4g}) (s + {found.slow:.4g})).

Model II has no compensator of its own: neither pole of its plant is stable, so only the filter's pole is left, and
without its steady gain nothing is. The paper uses Model I's for both, and so do we.

{shown("figure_05", "figure_07", "figure_08")}"""


def _pid(r: Results) -> str:
    lines = []
    for label, group in (("with", r.margins), ("without", r.bare_margins)):
        for name, m in group.items():
            source, model = name.split("_")
            functions = "published" if source == "published" else "our plant"
            poles = ", ".join(
                f"{pole.real:.3g}{pole.imag:+.3g}j" if pole.imag else f"{pole.real:.3g}" for pole in m.poles
            )
            lines.append(
                f"| {model} | {functions} | {label} | {m.crossover:.4f} | {m.phase_margin_deg:.1f} | "
                f"{'yes' if m.stable else 'no'} | {poles} |"
            )
    head = "| model | functions | compensator | crossover [rad/s] | phase margin [deg] | stable | poles [rad/s] |"
    own = r.margins["own_I"]
    hold = np.degrees(own.crossover * INTERVAL / 2)
    return f"""## 4. PID

Table 1: K_p = {PID.K_p} 1/s, T_i = {PID.T_i:.0f} s, T_d = {PID.T_d:.0f} s, N = {PID.N:.0f}.
The paper prints {CROSSOVER} rad/s and about {PHASE_MARGIN_DEG:.0f} degrees for both models.

{table(head, lines)}

Neither the published functions nor our plant give the printed crossover and margin. The loop above is continuous;
holding the pull speed for {INTERVAL:.0f} s costs another {hold:.1f} degrees at our crossover.

{_without(r)}

{shown("figure_06", "figure_09")}"""


def _without(r: Results) -> str:
    """The ramp without the compensator, beside the ramp with it."""
    lines = []
    for label, runs in (("with", r.ramp), ("without", r.bare_ramp)):
        for model, run in runs.items():
            n = cycle_numbers(run)
            fate = f"lost after {n['lived_min']:.0f} min" if run.failed else "kept"
            lines.append(
                f"| {model} | {label} | {fate} | {n['rmse_mm']:.3f} | {n['max_error_mm']:.2f} | "
                f"{100 * n['at_limit']:.0f} % | {n['late_swing_mm']:.2f} |"
            )
    kept, held = (ramp_numbers(runs["I"])["rmse_mm"] for runs in (r.bare_ramp, r.ramp))
    head = (
        "| model | compensator | crystal | true RMSE [mm] | largest true error [mm] | time at a pull limit | "
        "swing of r_c in its last hour [mm] |"
    )
    return f"""Without the compensator the linear loop is unstable on both models. What that means on the nonlinear
plant, whose pull speed has limits, shows in the temperature ramp of the next section:

{table(head, lines)}

In Model II the instability costs the crystal. In Model I, where a rising meniscus freezes faster, it ends in a bounded
limit cycle between the limits of the pull speed, which no puller should be asked for; yet the true radius is off by
{kept:.3f} mm RMS, against {held:.3f} mm with the compensator. The cycle holds the ring, and the ring's mean is honest;
what costs the compensated loop its radius is the compensator's washout (section 6). The RMSE of a lost crystal is
over the time it lived."""


def _closed_loop(r: Results) -> str:
    lines = [
        f"| {model} | " + " | ".join(f"{100 * value:.2f} %" for value in found) + " |"
        for model, found in r.case_difference.items()
    ]
    return f"""## 5. Closed loop on the nonlinear plant

max of A - 5 B over max of A, deviations from the operating point:

{table("| model | r_c | h_c | alpha_c | v_p |", lines)}

The ramp: T_1,ref rises by 0.5 K/min for 10 min and holds. The paper gives no duration, nor the gains of the temperature
loop, so its curves can be compared in shape only.

{shown("figure_10", "figure_11", "figure_12", "figure_13", "figure_14")}"""
