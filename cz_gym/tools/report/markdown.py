"""The report in Markdown, short tables for a terminal, and the report for a puller, which a grower reads."""

import shlex
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from shutil import get_terminal_size
from typing import Any

import numpy as np

from cz_gym.baselines.margins import HEADS
from cz_gym.evaluation.metrics import OUTSIDE
from cz_gym.evaluation.protocol import BOUND, REFERENCE, Case, Contender
from cz_gym.puller.file import DEFAULT
from cz_gym.support.command_line import filled
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO, MM, PERCENT
from cz_gym.tools.episodes import Benchmark
from cz_gym.tools.posterior import explained, shown
from cz_gym.tools.report.task_records import BODY_DRIVES, contract_hash, task_of

from . import tables

DIAMETER = 0.5
"""Millimetre of diameter, in millimetres of radius."""
FIT = 0.01
"""Largest share of lost crystals of a controller that is recommended [-]."""
VG = tables.Column("mean_pull_within_3pct", "v/G within 3 % [% of time]", 1, PERCENT)
BESIDE = (
    tables.FAILURES._replace(heading="crystals lost [%]"),
    tables.Column("rmse_mm", "diameter RMSE [mm]", 3, DIAMETER),
    tables.Column("max_error_mm", "largest diameter error [mm]", 2, DIAMETER),
    VG,
    tables.PULL_STEP,
    tables.HEATER_STEP,
    next(column for column in BODY_DRIVES if column.metric == "time_at_limits"),
)
"""Columns beside the scrap."""
SHORT = 5
"""Number of :data:`BESIDE` on a terminal."""
EXPLAINED = (
    "Scrap is the share of the time in which the diameter is outside the tolerance band (--tolerance); a lost crystal "
    "is scrap to the end. v/G stays within 3 % where the 30 min mean of the pull speed does."
)
AT_LIMITS, SWINGS = 0.2, 30.0
"""Share of time at its drives' limits [-], and heater step RMS [W], beyond which a controller gets a warning."""
MARGINS = ("controller", *HEADS)
"""Heads of :func:`margins`."""


def title(case: Case) -> str:
    """A heading that names the puller and its diameter."""
    return f"Puller {case.puller.name}, {2.0 * case.puller.parameters.r_0 / MM:g} mm in diameter"


def band(case: Case) -> str:
    """Return the tolerance band of the diameter in words."""
    return f"±{2.0 * (case.tolerance or 0.0) / MM:g} mm"


def outcome(benchmark: Benchmark, case: Case, interval: bool = True) -> tables.Table:
    """Return heads and rows of a scenario's table for a grower, the fewest losses first; short without ``interval``."""
    head = f"scrap: diameter outside {band(case)}" if interval else f"outside {band(case)}"
    scrap = tables.Column(OUTSIDE, f"{head} [% of time]", 2, PERCENT)
    columns = [each._replace(interval=interval) for each in (scrap, *BESIDE[: None if interval else SHORT])]
    ranked = sorted(benchmark.contenders, key=lambda each: _losses(benchmark, [case], each.name))
    heads = ("controller", *(column.heading for column in columns))
    return heads, tables.rows(benchmark.only(contenders=ranked), case, columns)


def _losses(benchmark: Benchmark, cases: Sequence[Case], name: str) -> tuple[float, float]:
    """Mean shares of lost crystals and of scrap of a contender over some scenarios."""
    lost, scrap = (
        [benchmark.mean(case, name, metric) for case in cases] for metric in (tables.FAILURES.metric, OUTSIDE)
    )  # fmt: skip
    return float(np.mean(lost)), float(np.mean(scrap))


def recommendation(benchmark: Benchmark) -> str:
    """Recommend the controller with the fewest lost crystals, then the least scrap.

    Bounds do not count, and a few crystals give no recommendation.
    """
    cases = tables.deciding(benchmark)
    able, number = [each for each in benchmark.contenders if not each.bound], len(benchmark.seeds(cases[0]))
    if not able or tables.too_few(benchmark):
        return f"No recommendation: {tables.crystals(number)}, and it takes a controller and at least {tables.FEWEST}."
    best = min(able, key=lambda each: _losses(benchmark, cases, each.name))
    lost, share = _losses(benchmark, cases, best.name)
    steady = np.mean([benchmark.mean(case, best.name, VG.metric) for case in cases])
    machine = cases[0].puller.name
    fate = (
        f"Recommended for {machine}: {best.name}, which loses {f'{lost / PERCENT:.2g} %' if lost else 'none'}"
        if lost <= FIT
        else f"No controller is fit for {machine}: {best.name} loses the fewest crystals, {lost / PERCENT:.2g} %"
    )
    place, up, down, phase, delay, _ = _margins(best, cases[0])[-1]
    loop = f" Its loop, opened at the {place}, bears {down} to {up} times its gain, {phase} degrees and {delay} s more."
    return (
        f"{fate} of {tables.crystals(number)} on {' and '.join(case.name for case in cases)}. The diameter is "
        f"outside {band(cases[0])} for {share / PERCENT:.2g} % of the time (scrap), and v/G is within 3 % for "
        f"{steady / PERCENT:.3g} %.{loop if delay not in ('', tables.NOTHING) else ''}"
    )


def warnings(benchmark: Benchmark) -> list[str]:
    """Return a sentence on each controller whose drives stand at limits or swing, with the scenario where most."""
    sentences = []
    for each in (each for each in benchmark.contenders if not each.bound):
        limits, steps = (
            max((benchmark.mean(case, each.name, metric), case.name) for case in benchmark.cases)
            for metric in ("time_at_limits", tables.HEATER_STEP.metric)
        )
        if limits[0] > AT_LIMITS:
            share = f"{limits[0] / PERCENT:.0f} % of the time on {limits[1]}"
            sentences.append(f"Warning: a drive of {each.name} stands at a limit for {share}.")
        if steps[0] * KILO > SWINGS:
            power = f"{steps[0] * KILO:.0f} W (RMS) a sample on {steps[1]}"
            sentences.append(f"Warning: {each.name} moves the heater by {power}.")
    return sentences


def margins(benchmark: Benchmark) -> list[tuple[str, ...]]:
    """Return rows for each controller: margins of its sampled loop, opened at pull, heater and ring."""
    return [(each.name, *row) for each in benchmark.contenders for row in _margins(each, benchmark.cases[0])]


@lru_cache(maxsize=64)
def _margins(contender: Contender, case: Case) -> list[tuple[str, ...]]:
    """Rows of a contender's margins, a row of dashes for one without a linear form."""
    config = case.config(contender.observation, contender.action)
    if not contender.learned:
        with suppress(CzError, AttributeError):  # it has no linear form, or is no feedback
            return shown(contender.make(config), config)
    return [(tables.NOTHING,) * len(HEADS)]


# The report of any benchmark, which begins with the verdict.

MARKERS = "<!-- {}:begin -->", "<!-- {}:end -->"
"""Markers around the part of a page that :func:`fill_in` writes."""


def summary(benchmark: Benchmark) -> str:
    """Return the overview in Markdown, and its contract below."""
    heads, groups = task_of(benchmark.cases[0]).overview(benchmark)
    lines = [line for group, listed in groups.items() for line in ((f"*{group}*", *[""] * (len(heads) - 1)), *listed)]
    rests_on = "plant, random scenarios, interval, horizon, reward, metrics"
    return f"{tables.markdown(heads, lines)}\n\nContract `{contract_hash(benchmark.cases)}` ({rests_on})."


def brief(benchmark: Benchmark) -> str:
    """Return :func:`summary` of the random scenarios, of the controllers that a figure would show first."""
    cases = tables.deciding(benchmark)
    return summary(benchmark.only(cases, tables.chosen(benchmark, cases[0], task_of(cases[0]).quoted_rows)))


def finding(benchmark: Benchmark) -> str:
    """Say in two sentences who is best by cost, of those that are not told the scenario and of those that are, and who
    holds the radius closest, with how much they move.

    Empty where one of these is missing, for a puller or of whole crystals, and for a few crystals.
    """
    cases = tables.deciding(benchmark)[:2]
    graded = cases[0].tolerance is not None or task_of(cases[0]).by_length
    if graded or tables.too_few(benchmark):
        return ""
    firsts = tables.firsts(benchmark)
    if len(firsts) < 2 + len(cases):
        return ""
    best, other, *told = firsts
    shown = (each._replace(interval=False) for each in (tables.COST, tables.RMSE, tables.PULL_STEP))
    cost, error, step = (partial(column.of, benchmark) for column in shown)
    kinds = ["learned agent" if each.learned else "classical controller" for each in (best, other)]
    ours = [f"{cost(case, best.name)} on `{case.name}`{_near(benchmark, case, best, other)}" for case in cases]
    theirs = [cost(case, other.name) for case in cases]
    aware = [f"{cost(case, each.name)} (`{each.name}`)" for case, each in zip(cases, told, strict=True)]
    closest = tables.closest(benchmark)
    radius = [f"{error(cases[0], each.name)} mm at pull steps of {step(cases[0], each.name)} mm/min"
              for each in (closest, best)]  # fmt: skip
    too = f"; `{best.name}` has {radius[1]}" if closest != best else ""
    return (
        f"**Not told which scenario it meets, the {kinds[0]} `{best.name}` ranks first: its mean cost, of radius error "
        f"and drive moves, is {' and '.join(ours)}**; the best {kinds[1]} that is not told, `{other.name}`, has "
        f"{' and '.join(theirs)}, and the best of those that are told, and tuned for each scenario, have "
        f"{' and '.join(aware)}. The radius error alone (RMSE) is least on `{cases[0].name}` with `{closest.name}`, "
        f"{radius[0]}{too}, and {_lost_by_agents(benchmark)}"
    )


def _lost_by_agents(benchmark: Benchmark) -> str:
    """Say how many crystals learned agents lose at most on a random scenario, and which of them does."""
    share, agents = tables.FAILURES._replace(interval=False), [each for each in benchmark.contenders if each.learned]
    lost = {(case, each.name): benchmark.mean(case, each.name, share.metric)
            for case in tables.deciding(benchmark) for each in agents if not each.bound}  # fmt: skip
    case, name = max(lost, key=lambda key: lost[key])
    if not lost[case, name]:
        return "no learned agent lost a crystal."
    most = share.of(benchmark, case, name)
    return f"learned agents lose at most {most} % of the crystals of a scenario (`{name}` on `{case.name}`)."


def _near(benchmark: Benchmark, case: Case, best: Contender, other: Contender) -> str:
    """Say where the intervals of two mean costs overlap."""
    get: Any = benchmark.get
    ours, theirs = (get(case, each.name, tables.COST.metric) for each in (best, other))
    return "" if ours.ends[1] < theirs.ends[0] else " (intervals overlap)"


def fill_in(page: str, benchmark: Benchmark) -> str:
    """Return a page with :func:`brief`, and :func:`finding`, between their markers, where it has these."""
    written = {task_of(benchmark.cases[0]).name: brief(benchmark), "finding": finding(benchmark)}
    for name, words in written.items():
        first, last = (marker.format(name) for marker in MARKERS)
        before, begin, rest = page.partition(first)
        _, end, after = rest.partition(last)
        page = f"{before}{begin}\n{words}\n{end}{after}" if end and words else page
    return page


def markdown(benchmark: Benchmark, command: str, figures: Iterable[str]) -> str:
    """Return ``report.md``; it begins with the verdict, on a puller with the recommendation."""
    case = benchmark.cases[0]
    parts = [
        *(_verdict(benchmark) if case.tolerance is None else _for_a_grower(benchmark)),
        *([found] if (found := finding(benchmark)) else []),
        "# Benchmark",
        *task_of(case).introduction(benchmark),
        *(f"![{name.partition('.')[0]}]({name})" for name in figures if name == "result.svg"),
        summary(benchmark),
        *(f"![{name.partition('.')[0]}]({name})" for name in figures if name != "result.svg"),
        "## Who took part",
        tables.markdown(*tables.who(benchmark), rule="---"),
        *([tables.ROBUSTNESS_MEANS] if benchmark.robustness else []),
        *(part for case in benchmark.cases for part in _scenario(benchmark, case)),
        "## How it was made",
        f"`{command}`; versions, hashes and seeds stand in benchmark.json.",
    ]
    return "\n\n".join(parts) + "\n"


def _verdict(benchmark: Benchmark) -> list[str]:
    verdict = task_of(benchmark.cases[0]).verdict(benchmark)
    return [verdict.sentence, *([tables.markdown(verdict.heads, verdict.rows)] if verdict.rows else [])]


def _for_a_grower(benchmark: Benchmark) -> list[str]:
    """The recommendation, what each controller gives on each scenario, and how much its loop bears."""
    parts = [recommendation(benchmark), f"# {title(benchmark.cases[0])}"]
    for case in benchmark.cases:
        parts += [f"**{case.name}**: {case.meaning}.", tables.markdown(*outcome(benchmark, case))]
    agents = any(each.learned for each in benchmark.contenders)
    parts += [EXPLAINED, *warnings(benchmark), tables.markdown(MARGINS, margins(benchmark))]
    parts.append(explained(benchmark.cases[0].puller))
    return [*parts, *(_verdict(benchmark) if agents else [])]


def _scenario(benchmark: Benchmark, case: Case) -> list[str]:
    meaning, task, compared = case.meaning, task_of(case), tables.comparison(benchmark, case)
    pooled = [each.name for each in benchmark.contenders if len(each.training_seeds) > 1]
    return [
        f"## {case.name} ({tables.crystals(len(benchmark.seeds(case)))})",
        f"{meaning[0].upper()}{meaning[1:]}.",
        *(_metrics(benchmark, case, columns) for columns in task.columns),
        *([tables.markdown(*task.losses(benchmark, case))] if task.losses else []),
        *([_metrics(benchmark, case, compared), *filter(None, [measured_from(benchmark, case)])] if compared else []),
        *([_training_seeds(benchmark, case, pooled)] if pooled else []),
    ]


def _metrics(benchmark: Benchmark, case: Case, columns: Sequence[tables.Column]) -> str:
    return tables.markdown(
        ("controller", *(column.heading for column in columns)), tables.rows(benchmark, case, columns)
    )


def measured_from(benchmark: Benchmark, case: Case) -> str:
    """Return a sentence on where the optimality gap comes from, or how to get it; none on a grower's puller."""
    if case.tolerance is not None:
        return ""
    names, earlier = [each.name for each in benchmark.contenders], benchmark.earlier_bound
    if met := int((earlier["scenario"] == case.name).sum()):
        fewest = min([met, *(len(benchmark.seeds(case, name)) for name in names)])
        found = f"`{BOUND}` of an earlier run (results/bounds), on the first {tables.crystals(fewest)}."
        return f"Optimality gaps are measured from {found}"
    if any(benchmark.get(case, name, "cost", "gap") for name in names):
        return f"Optimality gaps are measured from `{BOUND}` on the crystals that it met."
    place = f"--scenario {shlex.quote(case.file or case.name)}"
    return (
        f"No optimality gap: results/bounds does not have the bound for {case.name}, or it is no better than "
        f"{REFERENCE}. `python benchmark.py --slow --controllers {REFERENCE},{BOUND} {place} --out runs/bound` runs it."
    )


def _training_seeds(benchmark: Benchmark, case: Case, pooled: Sequence[str]) -> str:
    """Mean RMSE of each agent's best, middle and worst training seed, and the crystals that each of them lost."""
    lines = []
    for each in (each for each in benchmark.contenders if each.name in pooled):
        seeds, (errors, failed) = each.training_seeds, (
            benchmark.values(case, each.name, metric) for metric in (tables.RMSE.metric, tables.FAILURES.metric)
        )  # fmt: skip
        means, lost = errors.mean(axis=1), failed.sum(axis=1)
        figures = (f"{value:.3f}" for value in (means.min(), np.median(means), means.max()))
        losses = [f"{count:.0f} by seed {seed}" for seed, count in zip(seeds, lost, strict=True) if count]
        worst, losers = str(seeds[int(means.argmax())]), ", ".join(losses) or "none"
        lines.append((each.name, str(len(seeds)), *figures, worst, losers, str(errors.shape[1])))
    figures_of = ("best [mm]", "median [mm]", "worst [mm]")
    return tables.markdown(("agent", "training seeds", *figures_of, "worst seed", "crystals lost", "of"), lines)


def terminal(benchmark: Benchmark) -> str:
    """Return a short table a scenario, and the verdict or the recommendation, in lines of the terminal's width."""
    task, graded = task_of(benchmark.cases[0]), benchmark.cases[0].tolerance is not None
    verdict = task.verdict(benchmark, tables.COST._replace(interval=False))
    parts = [_short(benchmark, case) for case in benchmark.cases]
    parts += [filled(verdict.sentence)] if verdict.rows or not graded else []
    parts += [aligned(verdict.heads, verdict.rows)] if verdict.rows else []
    return "\n\n".join(parts + ([filled(recommendation(benchmark))] if graded else []))


def _short(benchmark: Benchmark, case: Case) -> str:
    grown_on = f", on {case.grown_on}" if case.file or case.puller != DEFAULT else ""
    if case.tolerance is not None:
        heads, lines = outcome(benchmark, case, interval=False)
    else:
        full = tables.rows(benchmark, case, columns := task_of(case).short)
        told = [
            0,
            *(place for place in range(1, len(columns) + 1) if any(line[place] != tables.NOTHING for line in full)),
        ]
        names = ("controller", *(column.heading for column in columns))
        heads, *lines = (tuple(line[place] for place in told) for line in (names, *full))
    heading = filled(f"{case.name} ({tables.crystals(len(benchmark.seeds(case)))}){grown_on}")
    return f"{heading}\n{aligned(heads, lines)}"


def aligned(heads: Sequence[str], lines: Iterable[tuple[str, ...]]) -> str:
    """Return a table in columns of characters, its units in a line of their own.

    Columns that the terminal has no room for follow below, beside the names again.
    """
    grid = [*zip(*(head.rstrip("]").partition(" [")[::2] for head in heads), strict=True), *lines]
    names, *columns = zip(*grid, strict=True)
    first = 2 + max(map(len, names))
    blocks, room = [[f"  {name}".ljust(first) for name in names]], get_terminal_size().columns - first
    for column in columns:
        width = 2 + max(map(len, column))
        if width > room and len(blocks[-1][0]) > first:
            blocks.append([f"  {name}".ljust(first) for name in names])
            room = get_terminal_size().columns - first
        blocks[-1] = [line + cell.rjust(width) for line, cell in zip(blocks[-1], column, strict=True)]
        room -= width
    return "\n\n".join("\n".join(line.rstrip() for line in block) for block in blocks)
