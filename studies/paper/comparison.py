"""Every published value beside ours, with the difference and, where they differ, why."""

import math
from typing import Any, NamedTuple

from cz_gym.body.linearisation import RadiusModel
from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.support.units import HOUR, MM

from . import experiments as ex
from .experiments import COMPENSATOR, CROSSOVER, ODE, PHASE_MARGIN_DEG, PUBLISHED, ZERO

DAY = 24.0 * HOUR


class Row(NamedTuple):
    """One line of the comparison."""

    quantity: str
    unit: str
    published: float | None
    """Value that Part II prints; None if it gives no number."""
    ours: float
    why: str = ""

    @property
    def difference(self) -> str:
        """Ours minus published, and in per cent of the published value."""
        if self.published is None:
            return "-"
        gap = self.ours - self.published
        return f"{gap:+.2g} ({100.0 * gap / abs(self.published):+.2f} %)"


def rows() -> list[Row]:
    """The whole comparison, in the paper's order."""
    linear = [row for model in ex.MODELS for row in _linear_rows(model, ex.linear_model("own", model))]
    return linear + _compensator_rows() + _margin_rows() + _response_rows()


def _linear_rows(model: str, ours: RadiusModel) -> list[Row]:
    paper, other = PUBLISHED[model], PUBLISHED["II" if model == "I" else "I"]
    split = (
        f"the paper's two numerators differ by {100 * abs(1 - paper.numerator / other.numerator):.1f} %, unexplained; "
        "both models share one geometry, so ours has one numerator, close to Model II's"
    )
    spread = "within the spread of silicon's surface tension and density"
    integrator = (
        "our growth rate does not depend on height in Model II: an exact integrator; the paper's pole has a time "
        f"constant of {1.0 / (DAY * paper.poles[0]):.0f} days"
    )
    product = "G_p and G_m trade a factor between the paper's models; their product, which the ring shows, does not"
    rounded = f"published value from its G_m; the text rounds to {ZERO}"
    # The paper's two poles, cone angle's first, as ours are ordered.
    cone, height = paper.poles if model == "I" else paper.poles[::-1]
    why_n, why_height, why_lead = (
        (split, "fitted by the nominal superheat dT_0", "see the product")
        if model == "I"
        else (spread, integrator, "fitted by the ring's slope phi_b")
    )
    why_cone = "time constants above a day; the loop does not feel them"
    return [
        Row(f"G_p,{model} numerator", "1/s", paper.numerator, ours.numerator, why_n),
        Row(f"G_p,{model} cone-angle pole", "rad/s", cone, ours.poles[0], why_cone),
        Row(f"G_p,{model} height pole", "rad/s", height, ours.poles[1], why_height),
        Row(f"G_m,{model} coefficient of s", "s", paper.lead, ours.lead, why_lead),
        Row(f"G_m,{model} constant", "-", paper.constant, ours.constant, "matters only below 1e-4 rad/s"),
        Row(
            f"G_p,{model} numerator x G_m,{model} coefficient", "-", paper.numerator * paper.lead,
            ours.numerator * ours.lead, product,
        ),
        Row(f"right half plane zero, Model {model}", "rad/s", paper.zero, ours.zero, rounded),
    ]  # fmt: skip


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
            Row(f"ramp, largest true error, Model {m}", "mm", None, n["max_error_mm"], 'the text says "small"'),
            Row(f"ramp, true RMSE, Model {m}", "mm", None, n["rmse_mm"]),
            Row(f"ramp, largest error of r_tilde, Model {m}", "mm", None, n["max_compensated_error_mm"]),
            Row(f"ramp, lowest pull speed, Model {m}", "mm/min", None, n["v_p_min_mm_per_min"]),
        ]
    return rows


def as_markdown(rows: list[Row]) -> str:
    """The comparison as a Markdown table, numbers with five significant digits."""
    lines = []
    for row in rows:
        published = "-" if row.published is None else f"{row.published:.5g}"
        lines.append((row.quantity, row.unit, published, f"{row.ours:.5g}", row.difference, row.why))
    return table(("quantity", "unit", "published", "ours", "difference", "why"), lines, "---")


def numbers() -> dict[str, Any]:
    """The content of numbers.json: the comparison's values by quantity, a published one null where there is none."""
    return {row.quantity: {"unit": row.unit, "published": row.published, "ours": row.ours} for row in rows()}
