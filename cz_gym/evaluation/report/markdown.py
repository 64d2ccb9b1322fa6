"""The benchmark's results for people: a Markdown report whose first line is the verdict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.results import BOUND, REFERENCE, SPEED, Benchmark, Outcome, ScenarioResult, common
from cz_gym.evaluation.statistics import Estimate
from cz_gym.units import HOUR, PERCENT

from .verdict import headline

NOTHING = "-"
BEGIN, END = "<!-- benchmark:begin -->", "<!-- benchmark:end -->"
"""Markers around the part of a page that :func:`fill_in` writes."""


class Column(NamedTuple):
    """A metric as a table shows it."""

    metric: str
    heading: str
    decimals: int
    unit: float = 1.0
    """What one shown unit is in the metric's own."""


ERROR = (
    Column("rmse_mm", "RMSE [mm]", 3),
    Column("rmse_observable_mm", "observable RMSE [mm]", 3),
    Column("max_error_mm", "largest error [mm]", 2),
    Column("within_half_mm", "within 0.5 mm [%]", 1, PERCENT),
    Column("failure_rate", "failures [%]", 1, PERCENT),
    Column("ground_off_pct", "ground off [%]", 2),
)
DRIVES = (
    Column("pull_rms_mm_per_min", "pull RMS [mm/min]", 3),
    Column("pull_step_rms_mm_per_min", "pull step RMS [mm/min]", 4),
    Column("mean_pull_within_3pct", "30 min mean pull within 3 % [%]", 1, PERCENT),
    Column("heater_step_rms_kw", "heater step RMS [kW]", 3),
    Column("growth_rate_rms_mm_per_min", "growth rate RMS [mm/min]", 3),
    Column("cost", "cost", 4),
    Column("return", "return", 0),
    Column(SPEED, "compute [us/step]", 2),
)

GAPS = (
    Column("optimality_gap", f"optimality gap in cost [% of {REFERENCE}'s]", 3, PERCENT),
    Column("optimality_gap_radius", f"in squared radius error [% of {REFERENCE}'s]", 1, PERCENT),
)


def summary(benchmark: Benchmark) -> str:
    """One table: RMSE on every scenario, then drives and failures on the first."""
    first = benchmark.scenarios[0]
    extras = (DRIVES[1], DRIVES[3], ERROR[4])
    headings = [*(scenario.row.name for scenario in benchmark.scenarios), *(column.heading for column in extras)]
    caption = (
        f"RMSE of the true radius [mm] on each scenario; the last {len(extras)} columns are of {first.row.name}. "
        "In brackets: 95 % interval."
    )
    rows = []
    for place, outcome in enumerate(first.outcomes):
        errors = [interval(scenario.outcomes[place].means["rmse_mm"], ERROR[0]) for scenario in benchmark.scenarios]
        others = [interval(outcome.means[column.metric], column) for column in extras]
        rows.append((label(outcome, first), *errors, *others))
    return f"{caption}\n\n{_table(('controller', *headings), rows)}"


def fill_in(page: str, benchmark: Benchmark) -> str:
    """A page with verdict and summary between its two markers; the page itself if it has none."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{headline(benchmark)}\n\n{summary(benchmark)}\n{end}{after}" if end else page


def markdown(benchmark: Benchmark, figures: Iterable[str]) -> str:
    """``report.md``; its first line is :func:`headline`."""
    config = benchmark.scenarios[0].row.config()
    counts = {len(scenario.seeds) for scenario in benchmark.scenarios}
    parts = [
        headline(benchmark),
        "# Benchmark",
        "Every controller meets the same crystals (test seeds), "
        f"{config.horizon / HOUR:.3g} h each at {config.control_interval:g} s control. Mean over crystals with its "
        "95 % bootstrap interval; a scenario without randomness is one crystal and has no interval. After a failure "
        "the radius error counts 8 mm to the end; drives, growth rate and ground-off are those of the time lived. "
        f"No failure in n crystals still allows a rate of up to 3/n, {3 / max(counts) / PERCENT:.2g} % at "
        f"n = {max(counts)}. docs/benchmark.md has the protocol and every formula.",
        summary(benchmark),
        "## Who took part",
        _table(
            ("controller", "reads", "what it is", "training seeds"),
            [(c.name, c.observation, c.meaning, _seeds(c.training_seeds)) for c in benchmark.controllers],
            rule="---",
        ),
    ]
    for scenario in benchmark.scenarios:
        parts += _scenario(scenario)
    parts += ["## Figures", *(f"![{name.removesuffix('.png')}]({name})" for name in figures)]
    parts += ["## How it was made", f"`{benchmark.command}`; versions, hashes and seeds stand in benchmark.json."]
    return "\n\n".join(parts) + "\n"


def _seeds(seeds: Sequence[int]) -> str:
    return ", ".join(str(seed) for seed in seeds) or NOTHING


def _scenario(scenario: ScenarioResult) -> list[str]:
    crystals = len(scenario.seeds)
    parts = [
        f"## {scenario.row.name} ({crystals} crystal{'s' if crystals > 1 else ''})",
        f"{scenario.row.meaning[0].upper()}{scenario.row.meaning[1:]}.",
        _metrics(scenario, ERROR),
        _metrics(scenario, DRIVES),
    ]
    if any(outcome.paired for outcome in scenario.outcomes):
        parts += [_comparison(scenario), _measured_from(scenario)]
    pooled = [outcome for outcome in scenario.outcomes if len(outcome.controller.training_seeds) > 1]
    if pooled:
        parts.append(_training_seeds(pooled))
    return parts


def _measured_from(scenario: ScenarioResult) -> str:
    """Where the optimality gap comes from, or how to get it."""
    row, bound = scenario.row.name, scenario.kept_bound
    if bound is not None:
        count = len(common(bound, *(outcome.sample for outcome in scenario.outcomes))[0].seeds)
        crystals = "the only crystal" if len(scenario.seeds) == 1 else f"the first {count} crystals"
        return f"Optimality gaps are measured from `{BOUND}`, kept from an earlier run (results/bounds), on {crystals}."
    if any(outcome.gap for outcome in scenario.outcomes):
        return f"Optimality gaps are measured from `{BOUND}` on the crystals that it met."
    return (
        f"No optimality gap: the bound is not kept for {row}, or is no better than {REFERENCE}. "
        f"`python benchmark.py --slow --controllers {REFERENCE},{BOUND} --scenarios {row}` runs it."
    )


def _training_seeds(pooled: Sequence[Outcome]) -> str:
    """How far the training seeds of each agent lie apart: mean RMSE of the best, the middle and the worst one, and how
    many crystals each lost."""
    names, rows = metric_names(), []
    for outcome in pooled:
        seeds = outcome.controller.training_seeds
        found = outcome.sample.values[..., names.index("rmse_mm")].mean(axis=1)
        lost = outcome.sample.values[..., names.index("failure_rate")].sum(axis=1)
        worst = int(found.argmax())
        figures = (f"{value:.3f}" for value in (found.min(), np.median(found), found.max()))
        losses = [f"{count:.0f} by seed {seed}" for seed, count in zip(seeds, lost, strict=True) if count]
        name, crystals = outcome.controller.name, len(outcome.sample.seeds)
        rows.append((name, str(len(seeds)), *figures, str(seeds[worst]), ", ".join(losses) or "none", str(crystals)))
    headings = (
        "agent",
        "training seeds",
        "best [mm]",
        "median [mm]",
        "worst [mm]",
        "worst seed",
        "crystals lost",
        "of",
    )
    return _table(headings, rows)


def label(outcome: Outcome, scenario: ScenarioResult) -> str:
    """The controller's name, and how many crystals it met if fewer than the scenario has."""
    met = len(outcome.sample.seeds)
    return outcome.controller.name + (f" (n = {met})" if met < len(scenario.seeds) else "")


def _metrics(scenario: ScenarioResult, columns: Sequence[Column]) -> str:
    rows = [
        (label(outcome, scenario), *(interval(outcome.means[column.metric], column) for column in columns))
        for outcome in scenario.outcomes
    ]
    return _table(("controller", *(column.heading for column in columns)), rows)


def _comparison(scenario: ScenarioResult) -> str:
    outcomes, rmse, step = scenario.outcomes, ERROR[0], DRIVES[1]
    gaps = [column for column in GAPS if any(gap_of(outcome, column) for outcome in outcomes)]
    rows = [
        (
            label(outcome, scenario),
            interval(outcome.cvar5["rmse_mm"], rmse),
            interval(outcome.paired["rmse_mm"], rmse) if outcome.paired else NOTHING,
            interval(outcome.improvement, rmse) if outcome.improvement else NOTHING,
            interval(outcome.paired[step.metric], step) if outcome.paired else NOTHING,
            *(interval(gap, column) if (gap := gap_of(outcome, column)) else NOTHING for column in gaps),
        )
        for outcome in outcomes
    ]
    headings = (
        "controller",
        "worst 5 % RMSE [mm]",
        f"RMSE less {REFERENCE}'s [mm]",
        f"better than {REFERENCE} with probability",
        f"pull step RMS less {REFERENCE}'s [mm/min]",
        *(column.heading for column in gaps),
    )
    return _table(headings, rows)


def gap_of(outcome: Outcome, column: Column) -> Estimate | None:
    """What an outcome says in a column of :data:`GAPS`."""
    return outcome.gap if column is GAPS[0] else outcome.gap_radius


def interval(estimate: Estimate, column: Column) -> str:
    """The mean in the column's unit, with its interval if it has one."""

    def number(value: float) -> str:
        text = f"{value / column.unit:.{column.decimals}f}"
        return text[1:] if text.startswith("-") and not text.strip("-0.") else text

    if estimate.ci95 is None:
        return number(estimate.mean)
    low, high = (number(value) for value in estimate.ci95)
    return f"{number(estimate.mean)} [{low}, {high}]"


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], rule: str = "--:") -> str:
    lines = [" | ".join(headings), " | ".join(["---", *(rule for _ in headings[1:])])]
    return "\n".join(f"| {line} |" for line in [*lines, *(" | ".join(row) for row in rows)])
