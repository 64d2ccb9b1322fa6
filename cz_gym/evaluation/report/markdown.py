"""The benchmark's results for people: a Markdown report whose first line is the verdict."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence

import numpy as np

from cz_gym.evaluation.results import BOUND, REFERENCE, Benchmark, Outcome, ScenarioResult, common
from cz_gym.units import HOUR, PERCENT

from .tables import DRIVES, ERROR, FAILURES, HEATER_STEP, NOTHING, PULL_STEP, RMSE, Column, comparison, crystals, rows
from .tables import markdown as table
from .verdict import headline

QUOTED = ("paper", "paper-tuned", "lqg-at-0.02", "gradient", "ppo")
"""Controllers that :func:`brief` shows."""
BEGIN, END = "<!-- benchmark:begin -->", "<!-- benchmark:end -->"
"""Markers around the part of a page that :func:`fill_in` writes."""


def summary(benchmark: Benchmark) -> str:
    """One table: RMSE on every scenario, then drives and failures on the first."""
    first, extras = benchmark.scenarios[0], (PULL_STEP, HEATER_STEP, FAILURES)
    caption = (
        f"RMSE of the true radius [mm] on each scenario; the last {len(extras)} columns are of {first.row.name}. "
        "In brackets: 95 % interval."
    )
    headings = [*(scenario.row.name for scenario in benchmark.scenarios), *(column.heading for column in extras)]
    errors = [[text for _, text in rows(scenario, (RMSE,))] for scenario in benchmark.scenarios]
    lines = [
        (name, *here, *others)
        for (name, *others), here in zip(rows(first, extras), zip(*errors, strict=True), strict=True)
    ]
    return f"{caption}\n\n{table(('controller', *headings), lines)}"


def brief(benchmark: Benchmark) -> str:
    """A table for readers in a hurry: the controllers of :data:`QUOTED`, or all, on the scenarios with randomness.

    RMSE and failures on each scenario, pull steps on the first.
    """
    scenarios = [each for each in benchmark.scenarios if len(each.seeds) > 1] or list(benchmark.scenarios)
    found = [{name: row for name, *row in rows(each, (RMSE, PULL_STEP, FAILURES))} for each in scenarios]
    names = [name for name in found[0] if name in QUOTED] or list(found[0])
    lines = []
    for name in names:
        errors, steps, failures = zip(*(each[name] for each in found), strict=True)
        plain = [" / ".join(text.partition(" [")[0] for text in texts) for texts in (steps[:1], failures)]
        lines.append((name, *errors, *plain))
    headings = [*(scenario.row.name for scenario in scenarios), PULL_STEP.heading, FAILURES.heading]
    return table(("controller", *headings), lines)


def fill_in(page: str, benchmark: Benchmark) -> str:
    """A page with :func:`brief` between its two markers; the page itself if it has none."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{brief(benchmark)}\n{end}{after}" if end else page


def markdown(benchmark: Benchmark, figures: Iterable[str]) -> str:
    """``report.md``; its first line is :func:`headline`."""
    config = benchmark.scenarios[0].row.config()
    most = max(len(scenario.seeds) for scenario in benchmark.scenarios)
    parts = [
        headline(benchmark),
        "# Benchmark",
        "Every controller meets the same crystals (test seeds), "
        f"{config.horizon / HOUR:.3g} h each at {config.control_interval:g} s control. Mean over crystals with its "
        "95 % bootstrap interval; a scenario without randomness is one crystal and has no interval. After a failure "
        "the radius error counts 8 mm to the end; drives, growth rate and ground-off are those of the time before it. "
        f"No failure in n crystals still allows a rate of up to 3/n, {3 / most / PERCENT:.2g} % at n = {most}. "
        "The first line compares radius errors alone: who moves the pull speed more can have less. "
        "docs/controllers/bounds.md compares at equal pull steps, "
        "docs/benchmark.md has the protocol and every formula.",
        summary(benchmark),
        *(f"![{name.removesuffix('.png')}]({name})" for name in figures),
        "## Who took part",
        table(
            ("controller", "reads", "what it is", "training seeds"),
            [
                (each.name, each.observation, each.meaning, ", ".join(map(str, each.training_seeds)) or NOTHING)
                for each in benchmark.controllers
            ],
            rule="---",
        ),
    ]
    for scenario in benchmark.scenarios:
        parts += _scenario(scenario)
    parts += ["## How it was made", f"`{benchmark.command}`; versions, hashes and seeds stand in benchmark.json."]
    return "\n\n".join(parts) + "\n"


def _scenario(scenario: ScenarioResult) -> list[str]:
    parts = [
        f"## {scenario.row.name} ({crystals(len(scenario.seeds))})",
        f"{scenario.row.meaning[0].upper()}{scenario.row.meaning[1:]}.",
        _metrics(scenario, ERROR),
        _metrics(scenario, DRIVES),
    ]
    if columns := comparison(scenario):
        parts += [_metrics(scenario, columns), measured_from(scenario)]
    pooled = [outcome for outcome in scenario.outcomes if len(outcome.controller.training_seeds) > 1]
    if pooled:
        parts.append(_training_seeds(pooled))
    return parts


def _metrics(scenario: ScenarioResult, columns: Sequence[Column]) -> str:
    return table(("controller", *(column.heading for column in columns)), rows(scenario, columns))


def measured_from(scenario: ScenarioResult) -> str:
    """Where the optimality gap comes from, or how to get it."""
    row, bound = scenario.row.name, scenario.earlier_bound
    if bound is not None:
        count = len(common(bound, *(outcome.sample for outcome in scenario.outcomes))[0].seeds)
        met = "the only crystal" if len(scenario.seeds) == 1 else f"the first {count} crystals"
        return f"Optimality gaps are measured from `{BOUND}` of an earlier run (results/bounds), on {met}."
    if any(outcome.gap for outcome in scenario.outcomes):
        return f"Optimality gaps are measured from `{BOUND}` on the crystals that it met."
    place = f"--scenario {shlex.quote(scenario.row.file)}" if scenario.row.file else f"--scenarios {row}"
    return (
        f"No optimality gap: results/bounds does not have the bound for {row}, or it is no better than {REFERENCE}. "
        f"`python benchmark.py --slow --controllers {REFERENCE},{BOUND} {place} --out runs/bound` runs it."
    )


def _training_seeds(pooled: Sequence[Outcome]) -> str:
    """How far the training seeds of each agent lie apart: mean RMSE of the best, the middle and the worst one, and how
    many crystals each lost."""
    lines = []
    for outcome in pooled:
        seeds, sample = outcome.controller.training_seeds, outcome.sample
        found, lost = sample.metric("rmse_mm").mean(axis=1), sample.metric("failure_rate").sum(axis=1)
        figures = (f"{value:.3f}" for value in (found.min(), np.median(found), found.max()))
        losses = [f"{count:.0f} by seed {seed}" for seed, count in zip(seeds, lost, strict=True) if count]
        worst = str(seeds[int(found.argmax())])
        losers = ", ".join(losses) or "none"
        lines.append((outcome.controller.name, str(len(seeds)), *figures, worst, losers, str(len(sample.seeds))))
    figures_of = ("best [mm]", "median [mm]", "worst [mm]")
    return table(("agent", "training seeds", *figures_of, "worst seed", "crystals lost", "of"), lines)
