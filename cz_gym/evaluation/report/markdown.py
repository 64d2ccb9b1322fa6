"""The benchmark's report as text: in Markdown, whose first line is the verdict, and as a short table for a terminal."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from cz_gym.evaluation.protocol import contract_hash
from cz_gym.evaluation.results import BOUND, REFERENCE, SPEED, Result, Sample, common
from cz_gym.puller import DEFAULT
from cz_gym.units import HOUR, PERCENT

from .tables import (
    DRIVES,
    ERROR,
    FAILURES,
    HEATER_STEP,
    NOTHING,
    PULL_STEP,
    RETURN,
    RMSE,
    Column,
    comparison,
    crystals,
    headline,
    label,
    rows,
)
from .tables import markdown as table

BEST = 2
"""Agents that :func:`brief` shows: those of the lowest RMSE."""
SHORT = (
    Column("max_error_mm", "max [mm]", 2, interval=False),
    Column("within_half_mm", "in 0.5 mm [%]", 1, PERCENT, interval=False),
    PULL_STEP._replace(heading="pull step [mm/min]", interval=False),
    HEATER_STEP._replace(heading="heater step [kW]", interval=False),
    FAILURES._replace(interval=False),
    Column(SPEED, "compute [us/step]", 2),
)
"""Columns without intervals, between RMSE and its paired difference."""
LESS = RMSE._replace(heading=f"RMSE less {REFERENCE}'s [mm]", kind="paired")
BEGIN, END = "<!-- benchmark:begin -->", "<!-- benchmark:end -->"
"""Markers around the part of a page that :func:`fill_in` writes."""


def summary(results: Sequence[Result]) -> str:
    """Return one table, and its contract below: RMSE and failures on each scenario, activity and return on the first.

    Contenders are grouped by what they knew.
    """
    alone = [column._replace(interval=False) for column in (PULL_STEP, HEATER_STEP, RETURN)]
    columns = (RMSE, FAILURES._replace(interval=False), *alone)
    found = [{name: row for name, *row in rows(result, columns)} for result in results]
    groups: dict[str, list[tuple[str, ...]]] = {}
    for sample in results[0].samples:
        name = label(sample, results[0])
        errors, failures, *others = zip(*(each[name] for each in found), strict=True)
        line = name, *errors, *(first for first, *_ in others), " / ".join(failures)
        groups.setdefault(sample.contender.knows, []).append(line)
    heads = "controller", *(result.row.name for result in results), *(column.heading for column in alone)
    lines = [line for group, listed in groups.items() for line in ((f"*{group}*", *[""] * len(heads)), *listed)]
    contract = contract_hash([result.row for result in results])
    below = f"Contract `{contract}` (plant, random scenarios, interval, horizon)."
    return f"{table((*heads, FAILURES.heading), lines)}\n\n{below}"


def brief(results: Sequence[Result]) -> str:
    """Return :func:`summary` of the random scenarios for the quoted controllers and the best agents.

    Everything is there if nobody is quoted, or nothing is random.
    """
    results = [result for result in results if len(result.seeds) > 1] or list(results)
    means = results[0].means
    samples = sorted(results[0].samples, key=lambda sample: means[sample.name][RMSE.metric].mean)
    best = [sample.name for sample in samples if sample.contender.learned and not sample.contender.bound][:BEST]
    shown = [sample for sample in results[0].samples if sample.contender.quoted or sample.name in best]
    return summary([replace(results[0], samples=tuple(shown or results[0].samples)), *results[1:]])


def fill_in(page: str, results: Sequence[Result]) -> str:
    """Return a page with :func:`brief` between its two markers; the page itself if it has none."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{brief(results)}\n{end}{after}" if end else page


def markdown(results: Sequence[Result], command: str, figures: Iterable[str]) -> str:
    """Return ``report.md``; its first line is :func:`headline`."""
    row = results[0].row
    config, most = row.config(), max(len(result.seeds) for result in results)
    parts = [
        headline(results),
        "# Benchmark",
        f"Every controller meets the same crystals (test seeds), {config.horizon / HOUR:.3g} h each at "
        f"{config.control_interval:g} s control, on {row.grown_on}.",
        "The tables show means over crystals with 95 % bootstrap intervals; a scenario without randomness is one "
        "crystal and has no interval. After a failure the radius error counts 8 mm to the end; drives, growth rate and "
        "ground-off are those of the time before it. No failure in n crystals still allows a rate of up to 3/n, "
        f"{3 / most / PERCENT:.2g} % at n = {most}. The first line compares radius errors alone: who moves the pull "
        "speed more can have less. docs/controllers/bounds.md compares at equal pull steps, docs/benchmark.md has the "
        "protocol and every formula.",
        "RMSE of the true radius [mm] with 95 % interval and failures on each scenario, pull steps on the first.",
        summary(results),
        *(f"![{name.removesuffix('.png')}]({name})" for name in figures),
        "## Who took part",
        table(
            ("controller", "reads", "what it is", "training seeds"),
            [
                (each.name, each.observation, each.meaning, ", ".join(map(str, each.training_seeds)) or NOTHING)
                for each in (sample.contender for sample in results[0].samples)
            ],
            rule="---",
        ),
    ]
    for result in results:
        parts += _scenario(result)
    parts += ["## How it was made", f"`{command}`; versions, hashes and seeds stand in benchmark.json."]
    return "\n\n".join(parts) + "\n"


def _scenario(result: Result) -> list[str]:
    meaning = result.row.meaning
    parts = [
        f"## {result.row.name} ({crystals(len(result.seeds))})",
        f"{meaning[0].upper()}{meaning[1:]}.",
        _metrics(result, ERROR),
        _metrics(result, DRIVES),
    ]
    if columns := comparison(result):
        parts += [_metrics(result, columns), measured_from(result)]
    pooled = [sample for sample in result.samples if len(sample.contender.training_seeds) > 1]
    if pooled:
        parts.append(_training_seeds(pooled))
    return parts


def _metrics(result: Result, columns: Sequence[Column]) -> str:
    return table(("controller", *(column.heading for column in columns)), rows(result, columns))


def measured_from(result: Result) -> str:
    """Return a sentence on where the optimality gap comes from, or how to get it."""
    row, bound = result.row, result.earlier_bound
    if bound is not None:
        count = crystals(len(common(bound, *result.samples)[0].seeds))
        return f"Optimality gaps are measured from `{BOUND}` of an earlier run (results/bounds), on the first {count}."
    if any(result.gaps.values()):
        return f"Optimality gaps are measured from `{BOUND}` on the crystals that it met."
    place = f"--scenario {shlex.quote(row.file)}" if row.file else f"--scenarios {row.name}"
    return (
        f"No optimality gap: results/bounds does not have the bound for {row.name}, or it is no better than "
        f"{REFERENCE}. `python benchmark.py --slow --controllers {REFERENCE},{BOUND} {place} --out runs/bound` runs it."
    )


def _training_seeds(pooled: Sequence[Sample]) -> str:
    """Spread over the training seeds of each agent: mean RMSE of the best, the middle and the worst one, and how
    many crystals each lost."""
    lines = []
    for sample in pooled:
        seeds = sample.contender.training_seeds
        found, lost = sample.metric("rmse_mm").mean(axis=1), sample.metric("failure_rate").sum(axis=1)
        figures = (f"{value:.3f}" for value in (found.min(), np.median(found), found.max()))
        losses = [f"{count:.0f} by seed {seed}" for seed, count in zip(seeds, lost, strict=True) if count]
        worst = str(seeds[int(found.argmax())])
        losers = ", ".join(losses) or "none"
        lines.append((sample.name, str(len(seeds)), *figures, worst, losers, str(len(sample.seeds))))
    figures_of = ("best [mm]", "median [mm]", "worst [mm]")
    return table(("agent", "training seeds", *figures_of, "worst seed", "crystals lost", "of"), lines)


def terminal(results: Sequence[Result]) -> str:
    """Return the short table: RMSE with its interval, then means, and the paired difference of RMSE."""
    return "\n\n".join([*map(_short, results), headline(results)])


def _short(result: Result) -> str:
    columns = (RMSE, *SHORT, LESS)
    headings = ["controller", *(column.heading for column in columns)]
    names, units = zip(*(heading.rstrip("]").partition(" [")[::2] for heading in headings), strict=True)
    grid = [names, units, *rows(result, columns)]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    row = result.row
    grown_on = f", on {row.grown_on}" if row.file or row.puller != DEFAULT else ""
    lines = [f"{row.name} ({crystals(len(result.seeds))}){grown_on}"]
    for name, *cells in grid:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([f"  {name:<{widths[0]}}", *padded]).rstrip())
    return "\n".join(lines)
