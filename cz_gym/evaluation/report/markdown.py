"""The benchmark's report as text: in Markdown, which begins with the verdict, and as short tables for a terminal."""

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from cz_gym.evaluation.protocol import contract_hash
from cz_gym.evaluation.results import BOUND, REFERENCE, SPEED, Result, Sample, common
from cz_gym.machine.puller import DEFAULT
from cz_gym.support.units import HOUR, MM, PERCENT

from . import grower
from .canvas import COLUMNS, chosen
from .tables import (
    DRIVES,
    ERROR,
    FAILURES,
    HEATER_STEP,
    PULL_STEP,
    RMSE,
    WHO,
    Column,
    comparison,
    crystals,
    deciding,
    overview,
    rows,
    verdict,
    who,
)
from .tables import markdown as table

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
    """Return :func:`overview` in Markdown, and its contract below."""
    heads, groups = overview(results)
    lines = [line for group, listed in groups.items() for line in ((f"*{group}*", *[""] * (len(heads) - 1)), *listed)]
    contract = contract_hash([result.row for result in results])
    rests_on = "plant, random scenarios, interval, horizon, reward, metrics"
    return f"{table(heads, lines)}\n\nContract `{contract}` ({rests_on})."


def brief(results: Sequence[Result]) -> str:
    """Return :func:`summary` of the random scenarios, of the controllers that the figure of a crystal shows."""
    first, *others = deciding(results)
    return summary([replace(first, samples=tuple(chosen(first.samples, COLUMNS))), *others])


def fill_in(page: str, results: Sequence[Result]) -> str:
    """Return a page with :func:`brief` between its two markers; the page itself if it has none."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{brief(results)}\n{end}{after}" if end else page


def markdown(results: Sequence[Result], command: str, figures: Iterable[str]) -> str:
    """Return ``report.md``; it begins with :func:`verdict`."""
    row = results[0].row
    config, most = row.config(), max(len(result.seeds) for result in results)
    parts = [
        *(_verdict(results) if row.tolerance is None else _for_a_grower(results)),
        "# Benchmark",
        f"Every controller meets the same crystals (test seeds), {config.horizon / HOUR:.3g} h each at "
        f"{config.control_interval:g} s control, on {row.grown_on}.",
        "The tables show means over crystals with 95 % bootstrap intervals; a scenario without randomness is one "
        f"crystal and has no interval. After a failure the radius error counts {config.radius_limit / MM:.3g} mm to "
        "the end; drives, growth rate and ground-off are those of the time before it. No failure in n crystals still "
        f"allows a rate of up to 3/n, {3 / most / PERCENT:.2g} % at n = {most}. The verdict compares radius errors "
        "alone: who moves the pull speed more can have less. docs/controllers/bounds.md compares at equal pull steps, "
        "docs/benchmark.md has the protocol and every formula.",
        "RMSE of the true radius [mm] with 95 % interval and failures on each scenario, pull steps on the first.",
        summary(results),
        *(f"![{name.removesuffix('.png')}]({name})" for name in figures),
        "## Who took part",
        table(WHO, who(results[0].samples), rule="---"),
    ]
    for result in results:
        parts += _scenario(result)
    parts += ["## How it was made", f"`{command}`; versions, hashes and seeds stand in benchmark.json."]
    return "\n\n".join(parts) + "\n"


def _verdict(results: Sequence[Result]) -> list[str]:
    found = verdict(results)
    return [found.sentence, *([table(found.heads, found.rows)] if found.rows else [])]


def _for_a_grower(results: Sequence[Result]) -> list[str]:
    """The recommendation, what each controller gives on each scenario, and how much its loop bears."""
    parts = [grower.recommendation(results), f"# {grower.title(results[0].row)}"]
    for result in results:
        parts += [f"**{result.row.name}**: {result.row.meaning}.", table(*grower.outcome(result))]
    margins = table(grower.MARGINS, grower.margins(results[0].samples, results[0]))
    agents = any(sample.contender.learned for sample in results[0].samples)
    return [*parts, grower.EXPLAINED, margins, grower.MARGINS_EXPLAINED, *(_verdict(results) if agents else [])]


def _scenario(result: Result) -> list[str]:
    meaning = result.row.meaning
    parts = [
        f"## {result.row.name} ({crystals(len(result.seeds))})",
        f"{meaning[0].upper()}{meaning[1:]}.",
        _metrics(result, ERROR),
        _metrics(result, DRIVES),
    ]
    if columns := comparison(result):
        parts += [_metrics(result, columns), *filter(None, [measured_from(result)])]
    pooled = [sample for sample in result.samples if len(sample.contender.training_seeds) > 1]
    if pooled:
        parts.append(_training_seeds(pooled))
    return parts


def _metrics(result: Result, columns: Sequence[Column]) -> str:
    return table(("controller", *(column.heading for column in columns)), rows(result, columns))


def measured_from(result: Result) -> str:
    """Return a sentence on where the optimality gap comes from, or how to get it; none on a grower's puller."""
    row, bound = result.row, result.earlier_bound
    if row.tolerance is not None:
        return ""
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
    """Mean RMSE of each agent's best, middle and worst training seed, and the crystals that each of them lost."""
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
    """Return a short table a scenario, RMSE with its interval, then means, and the verdict or the recommendation."""
    found = verdict(results, RMSE._replace(interval=False))
    parts = [*map(_short, results), *([found.sentence] if found.rows or results[0].row.tolerance is None else [])]
    parts += [_aligned(found.heads, found.rows)] if found.rows else []
    return "\n\n".join(parts + ([grower.recommendation(results)] if results[0].row.tolerance else []))


def _short(result: Result) -> str:
    columns, row = (RMSE, *SHORT, LESS), result.row
    grown_on = f", on {row.grown_on}" if row.file or row.puller != DEFAULT else ""
    heads: Sequence[str] = ["controller", *(column.heading for column in columns)]
    lines = rows(result, columns)
    if row.tolerance is not None:
        heads, lines = grower.outcome(result, interval=False)
    return f"{row.name} ({crystals(len(result.seeds))}){grown_on}\n{_aligned(heads, lines)}"


def _aligned(heads: Sequence[str], lines: Iterable[tuple[str, ...]]) -> str:
    """A table in columns of characters, its units in a line of their own."""
    grid = [*zip(*(head.rstrip("]").partition(" [")[::2] for head in heads), strict=True), *lines]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    padded = ((f"  {name:<{widths[0]}}", *map(str.rjust, cells, widths[1:])) for name, *cells in grid)
    return "\n".join("  ".join(cells).rstrip() for cells in padded)
