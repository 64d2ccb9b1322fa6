"""The report for a puller, which a grower reads: diameters, scrap, v/G, margins of the loops, and a recommendation."""

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from cz_gym.baselines.analysis import linear_form, loop_margins
from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.plots import chosen
from cz_gym.evaluation.protocol import Case, contract_hash
from cz_gym.evaluation.results import BOUND, REFERENCE, Result, Sample, common
from cz_gym.evaluation.statistics import Estimate, Resamples, means
from cz_gym.physics.plant import make_puller
from cz_gym.puller.file import DEFAULT
from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR, MM, PERCENT

from .crystals import contents_of
from .tables import (
    DRIVES,
    FAILURES,
    FEWEST,
    HEATER_STEP,
    NOTHING,
    PULL_STEP,
    RMSE,
    WHO,
    Column,
    comparison,
    crystals,
    deciding,
    label,
    rows,
    too_few,
    who,
)
from .tables import markdown as table

DIAMETER = 0.5
"""Millimetre of diameter, in millimetres of radius."""
FIT = 0.01
"""Largest share of lost crystals of a controller that is recommended [-]."""
VG = Column("mean_pull_within_3pct", "v/G within 3 % [% of time]", 1, PERCENT)
BESIDE = (
    FAILURES._replace(heading="crystals lost [%]"),
    Column("rmse_mm", "diameter RMSE [mm]", 3, DIAMETER),
    Column("max_error_mm", "largest diameter error [mm]", 2, DIAMETER),
    VG,
    PULL_STEP,
    HEATER_STEP,
    next(column for column in DRIVES if column.metric == "time_at_limits"),
)
"""Columns beside the scrap."""
SHORT = 5
"""Number of them on a terminal."""
EXPLAINED = (
    "Scrap is the share of the time in which the diameter is outside the tolerance band (--tolerance); a lost crystal "
    "is scrap to the end. v/G stays within 3 % where the 30 min mean of the pull speed does."
)
MARGINS_EXPLAINED = (
    "Margins of the sampled loop, opened at the ring, near rest, on the worse of the plant's Models I and II; "
    "- for a controller without a linear form."
)
MARGINS = ("controller", "gain may grow by", "gain may fall to", "phase margin [deg]", "delay margin [s]")
"""Heads of :func:`margins`."""


def title(case: Case) -> str:
    """A heading that names the puller and its diameter."""
    return f"Puller {case.puller.name}, {2.0 * case.puller.parameters.r_0 / MM:g} mm in diameter"


def band(result: Result) -> str:
    """The tolerance band of the diameter in words."""
    return f"±{2.0 * (result.case.tolerance or 0.0) / MM:g} mm"


def scrap(sample: Sample) -> Estimate | None:
    """Share of the time in which the diameter is outside the tolerance band, to the horizon once a crystal is lost."""
    if sample.outside is None:
        return None
    return means(sample.outside[:, :, None], Resamples.draw(len(sample.seeds)))[0]


def outcome(result: Result, interval: bool = True) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads and rows of a scenario's table for a grower, the fewest losses first; short without ``interval``."""
    head = f"scrap: diameter outside {band(result)}" if interval else f"outside {band(result)}"
    columns = Column("", f"{head} [% of time]", 2, PERCENT), *BESIDE[: None if interval else SHORT]
    column, *beside = (each._replace(interval=interval) for each in columns)
    rows = [
        (label(sample, result), column.text(scrap(sample)), *(c.text(c.estimate(result, sample.name)) for c in beside))
        for sample in sorted(result.samples, key=lambda sample: _order([result], sample))
    ]
    return ("controller", column.heading, *(each.heading for each in beside)), rows


def _order(results: Sequence[Result], sample: Sample) -> tuple[float, float]:
    """Mean shares of lost crystals and of scrap of a contender over some scenarios."""
    own = [one for result in results for one in result.samples if one.name == sample.name]
    lost = np.mean([one.metric("failure_rate").mean() for one in own])
    return float(lost), float(np.mean([estimate.mean if (estimate := scrap(one)) else np.inf for one in own]))


def recommendation(results: Sequence[Result]) -> str:
    """Who loses the fewest crystals and, of those, makes the least scrap; bounds and a few crystals do not count."""
    counted = deciding(results)
    able, number = [one for one in counted[0].samples if not one.contender.bound], len(counted[0].seeds)
    if not able or too_few(counted):
        return f"No recommendation: {crystals(number)}, and it takes a controller and at least {FEWEST}."
    best = min(able, key=lambda sample: _order(counted, sample))
    lost, share = _order(counted, best)
    steady = np.mean([result.means[best.name][VG.metric].mean for result in counted])
    machine, who = counted[0].case.puller.name, best.name
    fate = (
        f"Recommended for {machine}: {who}, which loses {f'{lost / PERCENT:.2g} %' if lost else 'none'}"
        if lost <= FIT
        else f"No controller is fit for {machine}: {who} loses the fewest crystals, {lost / PERCENT:.2g} %"
    )
    up, down, phase, delay = _margins(best, counted[0])
    loop = (
        f" Its loop bears {down} to {up} times its gain, {phase} degrees and a delay of {delay} s."
        if delay != NOTHING
        else ""
    )
    return (
        f"{fate} of {crystals(number)} on {' and '.join(result.case.name for result in counted)}. The diameter is "
        f"outside {band(counted[0])} for {share / PERCENT:.2g} % of the time (scrap), and v/G is within 3 % for "
        f"{steady / PERCENT:.3g} %.{loop}"
    )


def margins(samples: Sequence[Sample], result: Result) -> list[tuple[str, ...]]:
    """A row for each controller: margins of its sampled loop, opened at the ring, on the worse of Models I and II."""
    return [(sample.name, *_margins(sample, result)) for sample in samples]


def _margins(sample: Sample, result: Result) -> tuple[str, ...]:
    config = result.case.config(sample.contender.observation, sample.contender.action)
    absent = (NOTHING,) * (len(MARGINS) - 1)
    if sample.contender.learned:
        return absent
    try:
        form = linear_form(sample.contender.make(config), config.sole_scenario.sensor)
    except (CzError, AttributeError):  # it has no linear form, or is no feedback
        return absent
    pullers = [make_puller(config.parameters, mix, config.meniscus) for mix in (1.0, 0.0)]
    loops = [loop_margins(form.controller, puller, form.dt) for puller in pullers]
    if any(np.isnan(loop.sensitivity) for loop in loops):
        return ("unstable", *absent[1:])
    worst = (np.nanmin, "gain_up"), (np.nanmax, "gain_down"), (np.nanmin, "phase_deg"), (np.nanmin, "delay")
    values = ((pick, [getattr(loop, name) for loop in loops]) for pick, name in worst)
    return tuple("no limit" if np.isnan(both).all() else f"{pick(both):.3g}" for pick, both in values)


# The benchmark's report as text: in Markdown, which begins with the verdict, and as short tables for a terminal.

ROWS = 8
"""Number of controllers in a page's short table."""
MARKERS = "<!-- {}:begin -->", "<!-- {}:end -->"
"""Markers around the part of a page that :func:`fill_in` writes."""


def summary(results: Sequence[Result]) -> str:
    """Return :func:`overview` in Markdown, and its contract below."""
    heads, groups = contents_of(results[0].case).overview(results)
    lines = [line for group, listed in groups.items() for line in ((f"*{group}*", *[""] * (len(heads) - 1)), *listed)]
    contract = contract_hash([result.case for result in results])
    rests_on = "plant, random scenarios, interval, horizon, reward, metrics"
    return f"{table(heads, lines)}\n\nContract `{contract}` ({rests_on})."


def brief(results: Sequence[Result]) -> str:
    """Return :func:`summary` of the random scenarios, of the controllers that a figure would show first."""
    first, *others = deciding(results)
    if first.case.process == CRYSTAL:
        return summary(results)
    return summary([replace(first, samples=tuple(chosen(first.samples, ROWS))), *others])


def fill_in(page: str, results: Sequence[Result]) -> str:
    """Return a page with :func:`brief` between its two markers; the page itself if it has none."""
    name = "crystal" if results[0].case.process == CRYSTAL else "benchmark"
    first, last = (marker.format(name) for marker in MARKERS)
    before, begin, rest = page.partition(first)
    _, end, after = rest.partition(last)
    return f"{before}{begin}\n{brief(results)}\n{end}{after}" if end else page


def markdown(results: Sequence[Result], command: str, figures: Iterable[str]) -> str:
    """Return ``report.md``; it begins with :func:`verdict`."""
    case = results[0].case
    parts = [
        *(_verdict(results) if case.tolerance is None else _for_a_grower(results)),
        "# Benchmark",
        *(_of_crystals(results) if case.process == CRYSTAL else _of_bodies(results)),
        summary(results),
        *(f"![{name.removesuffix('.png')}]({name})" for name in figures),
        "## Who took part",
        table(WHO, who(results[0].samples), rule="---"),
    ]
    for result in results:
        parts += _scenario(result)
    parts += ["## How it was made", f"`{command}`; versions, hashes and seeds stand in benchmark.json."]
    return "\n\n".join(parts) + "\n"


INTERVALS = (
    "The tables show means over crystals with 95 % bootstrap intervals; a scenario without randomness is one crystal "
    "and has no interval."
)


def _none_of(results: Sequence[Result]) -> str:
    most = max(len(result.seeds) for result in results)
    return f"No failure in n crystals still allows a rate of up to 3/n, {3 / most / PERCENT:.2g} % at n = {most}."


def _of_bodies(results: Sequence[Result]) -> list[str]:
    """What was measured, and how it counts."""
    case = results[0].case
    config = case.config()
    return [
        f"Every controller meets the same crystals (test seeds), {config.horizon / HOUR:.3g} h each at "
        f"{config.control_interval:g} s control, on {case.grown_on}.",
        f"{INTERVALS} After a failure the radius error counts {config.radius_limit / MM:.3g} mm to "
        f"the end; drives, growth rate and ground-off are those of the time before it. {_none_of(results)} The verdict "
        "compares radius errors alone: who moves the pull speed more can have less. docs/controllers/bounds.md "
        "compares at equal pull steps, docs/benchmark.md has the protocol and every formula.",
        "RMSE of the true radius [mm] with 95 % interval and failures on each scenario, pull steps on the first.",
    ]


def _of_crystals(results: Sequence[Result]) -> list[str]:
    """The same of whole crystals."""
    case = results[0].case
    return [
        f"Every controller meets the same whole crystals, or parts of them (test seeds), at {case.control_interval:g} "
        f"s control, on {case.grown_on}.",
        f"{INTERVALS} Errors are those of the true radius against the recipe's at the length grown; a crystal that is "
        f"lost in crown or tail has the largest allowed one there. What is said of the body is said of the length that "
        f"was grown. {_none_of(results)} docs/crystal.md explains every column.",
        "Losses on each stage; crown, body and tail where the stage grows them; energy is the body's, if there is one.",
    ]


def _verdict(results: Sequence[Result]) -> list[str]:
    verdict = contents_of(results[0].case).verdict(results)
    return [verdict.sentence, *([table(verdict.heads, verdict.rows)] if verdict.rows else [])]


def _for_a_grower(results: Sequence[Result]) -> list[str]:
    """The recommendation, what each controller gives on each scenario, and how much its loop bears."""
    parts = [recommendation(results), f"# {title(results[0].case)}"]
    for result in results:
        parts += [f"**{result.case.name}**: {result.case.meaning}.", table(*outcome(result))]
    margin_table = table(MARGINS, margins(results[0].samples, results[0]))
    agents = any(sample.contender.learned for sample in results[0].samples)
    return [*parts, EXPLAINED, margin_table, MARGINS_EXPLAINED, *(_verdict(results) if agents else [])]


def _scenario(result: Result) -> list[str]:
    meaning, shown = result.case.meaning, contents_of(result.case)
    parts = [
        f"## {result.case.name} ({crystals(len(result.seeds))})",
        f"{meaning[0].upper()}{meaning[1:]}.",
        *(_metrics(result, columns) for columns in shown.columns),
        *([table(*shown.losses(result))] if shown.losses else []),
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
    case, bound = result.case, result.earlier_bound
    if case.tolerance is not None:
        return ""
    if bound is not None:
        count = crystals(len(common(bound, *result.samples)[0].seeds))
        return f"Optimality gaps are measured from `{BOUND}` of an earlier run (results/bounds), on the first {count}."
    if any(result.gaps.values()):
        return f"Optimality gaps are measured from `{BOUND}` on the crystals that it met."
    place = f"--scenario {shlex.quote(case.file)}" if case.file else f"--scenarios {case.name}"
    return (
        f"No optimality gap: results/bounds does not have the bound for {case.name}, or it is no better than "
        f"{REFERENCE}. `python benchmark.py --slow --controllers {REFERENCE},{BOUND} {place} --out runs/bound` runs it."
    )


def _training_seeds(pooled: Sequence[Sample]) -> str:
    """Mean RMSE of each agent's best, middle and worst training seed, and the crystals that each of them lost."""
    lines = []
    for sample in pooled:
        seeds = sample.contender.training_seeds
        errors, lost = sample.metric("rmse_mm").mean(axis=1), sample.metric("failure_rate").sum(axis=1)
        figures = (f"{value:.3f}" for value in (errors.min(), np.median(errors), errors.max()))
        losses = [f"{count:.0f} by seed {seed}" for seed, count in zip(seeds, lost, strict=True) if count]
        worst = str(seeds[int(errors.argmax())])
        losers = ", ".join(losses) or "none"
        lines.append((sample.name, str(len(seeds)), *figures, worst, losers, str(len(sample.seeds))))
    figures_of = ("best [mm]", "median [mm]", "worst [mm]")
    return table(("agent", "training seeds", *figures_of, "worst seed", "crystals lost", "of"), lines)


def terminal(results: Sequence[Result]) -> str:
    """Return a short table a scenario, RMSE with its interval, then means, and the verdict or the recommendation."""
    verdict = contents_of(results[0].case).verdict(results, RMSE._replace(interval=False))
    parts = [*map(_short, results), *([verdict.sentence] if verdict.rows or results[0].case.tolerance is None else [])]
    parts += [_aligned(verdict.heads, verdict.rows)] if verdict.rows else []
    return "\n\n".join(parts + ([recommendation(results)] if results[0].case.tolerance else []))


def _short(result: Result) -> str:
    case, columns = result.case, contents_of(result.case).short
    grown_on = f", on {case.grown_on}" if case.file or case.puller != DEFAULT else ""
    columns = tuple(each for each in columns if any(cell != NOTHING for _, cell in rows(result, [each])))
    heads: Sequence[str] = ["controller", *(column.heading for column in columns)]
    lines = rows(result, columns)
    if case.tolerance is not None:
        heads, lines = outcome(result, interval=False)
    return f"{case.name} ({crystals(len(result.seeds))}){grown_on}\n{_aligned(heads, lines)}"


def _aligned(heads: Sequence[str], lines: Iterable[tuple[str, ...]]) -> str:
    """A table in columns of characters, its units in a line of their own."""
    grid = [*zip(*(head.rstrip("]").partition(" [")[::2] for head in heads), strict=True), *lines]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    padded = ((f"  {name:<{widths[0]}}", *map(str.rjust, cells, widths[1:])) for name, *cells in grid)
    return "\n".join("  ".join(cells).rstrip() for cells in padded)
