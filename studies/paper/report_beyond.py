"""The report's last sections, on what the paper does not show, and what all sections are made with."""

from __future__ import annotations

from cz_gym.units import MM

from .beyond import SEEDS
from .experiments import INTERVAL
from .gallery import FIGURES
from .numbers import Results, ramp_numbers
from .published import MODEL_II, PID
from .rows import number


def shown(*marks: str) -> str:
    """Markdown of the figures whose file names begin so."""
    return "\n\n".join(f"![{f.caption}]({f.file})\n\n*{f.caption}*" for f in FIGURES if f.file.startswith(marks))


def table(head: str, lines: list[str]) -> str:
    """A table in Markdown."""
    columns = head.count("|") - 1
    return "\n".join([head, "|" + "---|" * columns, *lines])


def beyond(r: Results) -> str:
    """What the paper does not show."""
    bare = [
        f"| {c.cut_off:.0e} | "
        + " | ".join(f"{c.max_error[m] / MM:.2f} | {c.max_compensated_error[m] / MM:.2f}" for m in ("I", "II"))
        + f" | {c.phase_margin_deg['I']:.0f} | {c.phase_margin_deg['II']:.0f} |"
        for c in r.cut_offs
    ]
    head = (
        "| cut-off [rad/s] | r_c, I [mm] | r_tilde, I [mm] | r_c, II [mm] | r_tilde, II [mm] | margin, I [deg] | "
        "margin, II [deg] |"
    )
    noise = [
        f"| {n.noise / MM:.2f} | {n.expected_pull_rms_mm_per_min:.2f} | {n.pull_rms_mm_per_min:.2f} | "
        f"{100 * n.clipped:.0f} % | {n.rmse_mm:.3f} | {100 * n.failures:.0f} % |"
        for n in r.noise
    ]
    noise_head = (
        "| camera noise, sd [mm] | RMS of v_p expected [mm/min] | RMS of v_p - v_0 [mm/min] | time at a limit | "
        "true RMSE [mm] | lost |"
    )
    return f"""## 6. What the paper does not show

**The washout.** A warmer melt grows more slowly, so the loop must pull more slowly for good. The compensator answers a
lasting change of pull speed with a correction that fades only at the high-pass cut-off; meanwhile the loop holds
r_tilde and the crystal is off by the correction. Raising the cut-off shortens it, at little cost in margin until
it nears the zero. Largest errors in the ramp, compensator redesigned from our Model I for each cut-off:

{table(head, bare)}

**Noise.** The PID's gain at high frequency is K_p N = {PID.K_p * PID.N:.0f} mm/s per mm.
White camera noise, {INTERVAL:.0f} s samples,
reference held for an hour, mean of {len(SEEDS)} episodes. The pull speed is spoilt long before the crystal is:

{table(noise_head, noise)}

{shown("extra_b", "extra_c", "extra_d")}"""


def meniscus(r: Results) -> str:
    """Hurle against the exact meniscus."""
    lines = [
        f"| {p.r_c / MM:.1f} | {p.hurle.h / MM:.4f} | {p.exact.h / MM:.4f} | "
        f"{100 * (p.hurle.h / p.exact.h - 1):+.2f} % | "
        f"{p.hurle.slope_rate * MM:.4f} | {p.exact.slope_rate * MM:.4f} | {p.hurle.ring_offset / MM:.3f} | "
        f"{p.exact.ring_offset / MM:.3f} | {p.hurle.zero:.4f} | {p.exact.zero:.4f} |"
        for p in r.menisci
    ]
    head = (
        "| r_c [mm] | h, Hurle [mm] | h, exact [mm] | difference | d alpha_c/d h, Hurle [rad/mm] | exact | "
        "ring offset, Hurle [mm] | exact | zero, Hurle [rad/s] | exact |"
    )
    slopes = [f"| {p.phi_b_deg:g} | {p.hurle:.2f} | {p.exact:.2f} |" for p in r.ring_slopes]
    exact, hurle = ramp_numbers(r.exact_ramp), ramp_numbers(r.ramp["I"])
    return f"""## 7. Hurle against the exact meniscus

At the operating point the axisymmetric Young-Laplace equation gives {number(r.exact_h / MM)} mm, Hurle's closed form
{number(r.ramp["I"].signals.h_c[0] / MM)} mm.
On a plant with the exact meniscus the printed controller's largest error in the ramp is
{exact["max_error_mm"]:.3f} mm against {hurle["max_error_mm"]:.3f} mm (Model I).

{table(head, lines)}

The zero differs most. It hangs on how fast the ring moves with the height, which Hurle's profile overstates: on the
exact meniscus the coefficient of s in G_m hardly depends on where the ring is seen, and with the capillary constant
that gives the paper's G_p no slope phi_b gives its {MODEL_II.lead:.1f} s. That number belongs to the approximate
profile; the exact meniscus makes the inverse response somewhat milder.

{table("| phi_b [deg] | coefficient of s, Hurle [s] | exact [s] |", slopes)}

{shown("extra_e")}"""
