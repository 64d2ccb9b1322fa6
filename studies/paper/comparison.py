"""Every published value beside ours, with the difference and, where they differ, why."""

import math
from typing import Any, NamedTuple

from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.support.units import HOUR, MM

from . import experiments as ex
from .experiments import COMPENSATOR, CROSSOVER, ODE, PHASE_MARGIN_DEG, PUBLISHED, ZERO


class Row(NamedTuple):
    """One line of the comparison; ``published`` is None where Part II gives no number."""

    quantity: str
    unit: str
    published: float | None
    ours: float
    why: str = ""


def rows() -> list[Row]:
    """The whole comparison, in the paper's order."""
    return [*_linear_rows("I"), *_linear_rows("II"), *_compensator_rows(), *_margin_rows(), *_response_rows()]


def _linear_rows(model: str) -> list[Row]:
    paper, ours = PUBLISHED[model], ex.linear_model("own", model)
    apart = 100 * abs(1 - PUBLISHED["I"].numerator / PUBLISHED["II"].numerator)
    why_numerator, why_height, why_lead = {
        "I": (
            f"the paper's two numerators differ by {apart:.1f} %, unexplained; both models share one geometry, so ours "
            "has one numerator, close to Model II's",
            "fitted by the nominal superheat dT_0",
            "see the product",
        ),
        "II": (
            "within the spread of silicon's surface tension and density",
            "our growth rate does not depend on height in Model II: an exact integrator; the paper's pole has a time "
            f"constant of {1.0 / (24.0 * HOUR * paper.poles[0]):.0f} days",
            "fitted by the ring's slope phi_b",
        ),
    }[model]
    product = "G_p and G_m trade a factor between the paper's models; their product, which the ring shows, does not"
    slow = "time constants above a day; the loop does not feel them"
    rounded = f"published value from its G_m; the text rounds to {ZERO}"
    # The paper's two poles, cone angle's first, as ours are ordered.
    cone, height = paper.poles if model == "I" else paper.poles[::-1]
    both = paper.numerator * paper.lead, ours.numerator * ours.lead
    return [
        Row(f"G_p,{model} numerator", "1/s", paper.numerator, ours.numerator, why_numerator),
        Row(f"G_p,{model} cone-angle pole", "rad/s", cone, ours.poles[0], slow),
        Row(f"G_p,{model} height pole", "rad/s", height, ours.poles[1], why_height),
        Row(f"G_m,{model} coefficient of s", "s", paper.lead, ours.lead, why_lead),
        Row(f"G_m,{model} constant", "-", paper.constant, ours.constant, "matters only below 1e-4 rad/s"),
        Row(f"G_p,{model} numerator x G_m,{model} coefficient", "-", *both, product),
        Row(f"right half plane zero, Model {model}", "rad/s", paper.zero, ours.zero, rounded),
    ]


def _compensator_rows() -> list[Row]:
    published, own = (ex.compensator(source) for source in ex.SOURCES)
    poles = COMPENSATOR.fast, COMPENSATOR.slow
    return [
        Row("compensator numerator, procedure on published functions", "1/s", COMPENSATOR.gain, published.gain),
        Row("compensator numerator, procedure on our plant", "1/s", COMPENSATOR.gain, own.gain, "our G_p and G_m"),
        Row("compensator fast pole, our plant", "rad/s", COMPENSATOR.fast, own.fast, "the plant's stable pole"),
        Row("compensator slow pole", "rad/s", COMPENSATOR.slow, own.slow, "the high-pass cut-off"),
        Row("differential equation, y_pc', printed poles", "rad/s", ODE[0], sum(poles), "sum of the poles"),
        Row("differential equation, y_pc, printed poles", "rad2/s2", ODE[1], math.prod(poles), "their product"),
    ]


def _margin_rows() -> list[Row]:
    rows = []
    for source, what, why in (
        ("published", "published functions", "does not follow from the paper's own numbers"),
        ("own", "our plant", "as from published functions"),
    ):
        for model in ex.MODELS:
            margin, name = ex.loop_margins(source, model), f"Model {model}, {what}"
            rows.append(Row(f"crossover, {name}", "rad/s", CROSSOVER, margin.crossover, why))
            rows.append(Row(f"phase margin, {name}", "deg", PHASE_MARGIN_DEG, margin.phase_margin_deg, why))
    for model in ex.MODELS:
        worst = float(ex.loop_margins("own", model, compensated=False).poles.real.max())
        name = f"rightmost closed-loop pole without compensator, Model {model}"
        rows.append(Row(name, "1/s", None, worst, "positive: the linear loop is unstable"))
    return rows


def _response_rows() -> list[Row]:
    rows = []
    for m in ex.MODELS:
        for change, over in (("-10 % over 600 s", 600.0), ("sudden -10 %", ex.SUDDEN)):
            depth, recovery = ex.inverse_response(ex.pull_change(m, over=over))
            rows.append(Row(f"inverse response, {change}, depth, Model {m}", "mm", None, depth / MM))
            rows.append(Row(f"inverse response, {change}, recovery, Model {m}", "s", None, recovery))
        rows += [
            Row(f"cases, max of A - 5 B over max of A, {name}, Model {m}", "-", None, value, "plotted, not given")
            for name, value in ex.case_difference(m).items()
        ]
        n = ex.ramp_numbers(ex.ramp(m))
        rows += [
            Row(f"ramp, {what}, Model {m}", unit, None, n[name], why)
            for what, unit, name, why in (
                ("largest true error", "mm", "max_error_mm", 'the text says "small"'),
                ("true RMSE", "mm", "rmse_mm", ""),
                ("largest error of r_tilde", "mm", "max_compensated_error_mm", ""),
                ("lowest pull speed", "mm/min", "v_p_min_mm_per_min", ""),
            )
        ]
    return rows


def as_markdown(rows: list[Row]) -> str:
    """The comparison as a Markdown table, numbers with five significant digits."""
    lines = []
    for row in rows:
        published, difference = "-", "-"
        if row.published is not None:
            gap = row.ours - row.published
            published, difference = f"{row.published:.5g}", f"{gap:+.2g} ({100.0 * gap / abs(row.published):+.2f} %)"
        lines.append((row.quantity, row.unit, published, f"{row.ours:.5g}", difference, row.why))
    return table(("quantity", "unit", "published", "ours", "difference", "why"), lines, "---")


def numbers() -> dict[str, Any]:
    """The content of numbers.json: the comparison's values by quantity, a published one null where there is none."""
    return {row.quantity: {"unit": row.unit, "published": row.published, "ours": row.ours} for row in rows()}
