"""The report: sections, figures and tables, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from cz_gym import HURLE
from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.units import MM

from . import beyond_paper as beyond
from . import experiments as ex
from .comparison import as_markdown, rows
from .figures import FIGURES
from .published import CROSSOVER, MODEL_II, PHASE_MARGIN_DEG, PID


def report() -> str:
    """The whole report."""
    sections = (_opening, _open_loop, _linear, _compensator, _pid, _closed_loop, _beyond, _meniscus)
    return "\n\n".join(section() for section in sections) + "\n"


def _shown(*marks: str) -> str:
    """Markdown of the figures whose file names begin so."""
    return "\n\n".join(f"![{f.caption}]({f.file})\n\n*{f.caption}*" for f in FIGURES if f.file.startswith(marks))


def _table(head: str, lines: Iterable[Iterable[str]]) -> str:
    """A table; the names of its columns are separated by |."""
    return table(head.split(" | "), lines, "---")


def _opening() -> str:
    numbers = ex.ramp_numbers(ex.ramp("I"))
    gains = [ex.compensator(source).gain for source in ex.SOURCES]
    published = ex.loop_margins("published", "I"), ex.loop_margins("published", "II")
    worst = max(max(ex.case_difference(*ex.cases(model))) for model in ex.MODELS)
    return f"""# Part II, redone on our plant

Every value that Bukhari, Hovd and Winkler print in Part II beside what our plant, or the paper's own functions, give.
Written by `python -m studies.paper`: the printed values stand in `studies/paper/published.py`, all others are
computed; the explanations and reasons were written for these. `docs/paper.md` says what each step means.

- The plant's linear model agrees with the paper's Model II; Model I's G_p and G_m differ by a factor that cancels
  in their product.
- The design procedure returns the printed compensator: {gains[0]:.5f} from the published functions,
  {gains[1]:.5f} from our plant.
- The printed crossover ({CROSSOVER} rad/s) and phase margin ({PHASE_MARGIN_DEG:.0f} degrees) **do not follow from the
  paper's own functions and Table 1**: those give {published[0].crossover:.4f} rad/s and
  {published[0].phase_margin_deg:.1f} degrees (I), {published[1].crossover:.4f} rad/s and
  {published[1].phase_margin_deg:.1f} degrees (II).
- Cases A and B scaled by 5 differ by at most {100 * worst:.1f} % of the largest deviation of any signal.
- In the temperature ramp the true radius is off by up to {numbers["max_error_mm"]:.2f} mm while the compensated
  measurement shows {numbers["max_compensated_error_mm"]:.2f} mm.

## Published beside computed

A dash means that the paper gives no number.

{as_markdown(rows())}"""


def _open_loop() -> str:
    smooth = {model: ex.inverse_response(ex.pull_change(model)) for model in ex.MODELS}
    sudden = ex.inverse_response(ex.pull_change("I", over=ex.SUDDEN))
    return f"""## 1. Open loop

The pull speed falls by 10 % along the quintic 10 s^3 - 15 s^4 + 6 s^5 over 600 s, the heater at nominal power. The
paper shows its profile without numbers, so the shapes can be compared and not the values. The crystal thickens at
once; the ring first shows it thinner, by {1e3 * smooth["I"].depth / MM:.2f} µm (I) and
{1e3 * smooth["II"].depth / MM:.2f} µm (II), and is back after {smooth["I"].recovery:.0f} s and
{smooth["II"].recovery:.0f} s. The dip is small because the change is slow against the zero: a sudden change of the
same size gives {1e3 * sudden.depth / MM:.1f} µm and {sudden.recovery:.0f} s (I).
In Model II the growth rate is constant, in Model I it falls with the meniscus, which slows the widening.

{_shown("figure_01", "figure_02", "figure_03")}"""


def _linear() -> str:
    functions = [
        (name, f"{m.numerator:.7f}", ", ".join(f"{pole:.4g}" for pole in m.poles),
         f"{m.lead:.4f} s + {m.constant:.4f}", f"{m.zero:.5f}", f"{m.numerator * m.constant:.7f}")
        for name, m in ((name, ex.linear_model("own", name)) for name in ex.MODELS)
    ]  # fmt: skip
    head = "model | numerator of G_p [1/s] | poles [rad/s] | G_m | zero [rad/s] | gain, numerator x constant [1/s]"
    return f"""## 2. Linearisation

Derivatives by complex step through the functions that are simulated; melt temperature held, as in the paper.

{_table(head, functions)}

{_shown("figure_04")}"""


def _compensator() -> str:
    printed, own = (
        f"{c.gain:.5f} s / ((s + {c.fast:.4g}) (s + {c.slow:.4g}))" for c in map(ex.compensator, ex.SOURCES)
    )
    return f"""## 3. Compensator

Ideal compensator G_p (1 - G_m), high-pass filter 5000 s/(5000 s + 1), stable part by ordered Schur form and Sylvester
equation, constant of the numerator removed. From the published functions of Model I:

    G_pc,real(s) = {printed}

and from our plant {own}.

Model II has no compensator of its own: neither pole of its plant is stable, so only the filter's pole is left, and
without its steady gain nothing is. The paper uses Model I's for both, and so do we.

{_shown("figure_05", "figure_07", "figure_08")}"""


def _pid() -> str:
    def complex_number(pole: complex) -> str:
        return f"{pole.real:.3g}{pole.imag:+.3g}j" if pole.imag else f"{pole.real:.3g}"

    lines = []
    for compensated, (source, functions), model in product(
        (True, False), zip(ex.SOURCES, ("published", "our plant"), strict=True), ex.MODELS
    ):
        m = ex.loop_margins(source, model, compensated)
        numbers = f"{m.crossover:.4f}", f"{m.phase_margin_deg:.1f}", "yes" if m.stable else "no"
        poles = ", ".join(map(complex_number, m.poles))
        lines.append((model, functions, "with" if compensated else "without", *numbers, poles))
    head = "model | functions | compensator | crossover [rad/s] | phase margin [deg] | stable | poles [rad/s]"
    hold = np.degrees(ex.loop_margins("own", "I").crossover * ex.INTERVAL / 2)
    return f"""## 4. PID

Table 1: K_p = {PID.K_p} 1/s, T_i = {PID.T_i:.0f} s, T_d = {PID.T_d:.0f} s, N = {PID.N:.0f}.
The paper prints {CROSSOVER} rad/s and about {PHASE_MARGIN_DEG:.0f} degrees for both models.

{_table(head, lines)}

Neither the published functions nor our plant give the printed crossover and margin. The loop above is continuous;
holding the pull speed for {ex.INTERVAL:.0f} s costs another {hold:.1f} degrees at our crossover.

{_without()}

{_shown("figure_06", "figure_09")}"""


def _without() -> str:
    """The ramp without the compensator, beside the ramp with it."""
    lines = []
    for label, policy in (("with", ex.PRINTED), ("without", ex.BARE)):
        for model in ex.MODELS:
            run = ex.ramp(model, policy)
            n = ex.cycle_numbers(run)
            fate = f"lost after {n['lived_min']:.0f} min" if run.failed else "kept"
            errors = f"{n['rmse_mm']:.3f}", f"{n['max_error_mm']:.2f}"
            lines.append((model, label, fate, *errors, f"{100 * n['at_limit']:.0f} %", f"{n['late_swing_mm']:.2f}"))
    kept, held = (ex.ramp_numbers(ex.ramp("I", policy))["rmse_mm"] for policy in (ex.BARE, ex.PRINTED))
    head = (
        "model | compensator | crystal | true RMSE [mm] | largest true error [mm] | time at a pull limit | "
        "swing of r_c in its last hour [mm]"
    )
    return f"""Without the compensator the linear loop is unstable on both models. What that means on the nonlinear
plant, whose pull speed has limits, shows in the temperature ramp of the next section:

{_table(head, lines)}

In Model II the instability costs the crystal. In Model I, where a rising meniscus freezes faster, it ends in a bounded
limit cycle between the limits of the pull speed, which no puller should be asked for; yet the true radius is off by
{kept:.3f} mm RMS, against {held:.3f} mm with the compensator. The cycle holds the ring, whose mean is that of the
crystal; the compensated loop loses accuracy by the compensator's washout (section 6). The RMSE of a lost crystal is
over the time it lived."""


def _closed_loop() -> str:
    lines = [(m, *(f"{100 * value:.2f} %" for value in ex.case_difference(*ex.cases(m)))) for m in ex.MODELS]
    return f"""## 5. Closed loop on the nonlinear plant

max of A - 5 B over max of A, deviations from the operating point:

{_table("model | r_c | h_c | alpha_c | v_p", lines)}

The ramp: T_1,ref rises by 0.5 K/min for 10 min and holds. The paper gives no duration, nor the gains of the temperature
loop, so its curves can be compared in shape only.

{_shown("figure_10", "figure_11", "figure_12", "figure_13", "figure_14")}"""


def _beyond() -> str:
    cut_offs = []
    for cut_off in beyond.CUT_OFFS:
        both = [beyond.cut_off_result(cut_off, model) for model in ex.MODELS]
        peaks = (f"{error / MM:.2f}" for _, *errors in both for error in errors)
        cut_offs.append((f"{cut_off:.0e}", *peaks, *(f"{found.phase_margin_deg:.0f}" for found in both)))
    head = (
        "cut-off [rad/s] | r_c, I [mm] | r_tilde, I [mm] | r_c, II [mm] | r_tilde, II [mm] | margin, I [deg] | "
        "margin, II [deg]"
    )
    return f"""## 6. What the paper does not show

**The washout.** A warmer melt grows more slowly, so the loop must pull more slowly for good. The compensator answers a
lasting change of pull speed with a correction that fades only at the high-pass cut-off; meanwhile the loop holds
r_tilde and the crystal is off by the correction. Raising the cut-off shortens it, at little cost in margin until
it nears the zero. Largest errors in the ramp, compensator redesigned from our Model I for each cut-off:

{_table(head, cut_offs)}"""


def _meniscus() -> str:
    lines = [(name, *(f"{value:.4f}" for value in both)) for name, both in beyond.compare_menisci().items()]
    largest, hurles = (
        ex.ramp_numbers(ex.ramp("I", meniscus=meniscus))["max_error_mm"] for meniscus in (YOUNG_LAPLACE, HURLE)
    )
    hurle, exact = beyond.ring_slopes()
    slopes = f"{beyond.RING_SLOPES_DEG[0]:g} to {beyond.RING_SLOPES_DEG[-1]:g} degrees"
    return f"""## 7. Hurle against the exact meniscus

At the operating point, Hurle's closed form and the axisymmetric Young-Laplace equation:

{_table("quantity | Hurle | exact", lines)}

On a plant with the exact meniscus the printed controller's largest error in the ramp is {largest:.3f} mm against
{hurles:.3f} mm (Model I).

The zero differs most. It depends on how fast the ring moves with the height, which Hurle's profile overstates. For ring
slopes phi_b of {slopes} the coefficient of s in G_m lies between {min(hurle):.1f} and {max(hurle):.1f} s on Hurle's
meniscus, and between {min(exact):.1f} and {max(exact):.1f} s on the exact one: there, with the capillary constant that
gives the paper's G_p, no slope gives its {MODEL_II.lead:.1f} s. So that number belongs to the approximate profile; the
exact meniscus makes the inverse response somewhat milder."""
