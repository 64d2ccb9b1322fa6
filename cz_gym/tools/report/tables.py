"""Texts that every form of the report has: the verdict, and the tables' columns, estimates, numbers and names."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from cz_gym.evaluation.results import REFERENCE, SPEED, Estimates, Result, Sample
from cz_gym.evaluation.statistics import Estimate
from cz_gym.support.units import PERCENT

NOTHING = "-"
FEWEST = 20
"""Least number of crystals for a verdict on a scenario with randomness."""


class Column(NamedTuple):
    """A column of a table: a metric of one of a result's kinds of estimates."""

    metric: str
    heading: str
    decimals: int
    unit: float = 1.0
    """Unit of the column, in units of the metric."""
    kind: str = "means"
    """Name of the estimates, an attribute of :class:`Result`."""
    interval: bool = True
    """Whether the intervals are shown."""

    def estimate(self, result: Result, name: str) -> Estimate | None:
        """Return the estimate of a contender in the metric's unit; None where there is none."""
        estimates: Estimates = getattr(result, self.kind)
        return estimates.get(name, {}).get(self.metric)

    def text(self, estimate: Estimate | None) -> str:
        """Return the mean in the column's unit, with its interval if it has one that is shown."""
        if estimate and not self.interval:
            estimate = estimate._replace(ci95=None)
        known = estimate and estimate.mean == estimate.mean  # NaN: the metric does not apply
        return estimate.text(f"z.{self.decimals}f", self.unit) if estimate and known else NOTHING


RMSE = Column("rmse_mm", "RMSE [mm]", 3)
FAILURES = Column("failure_rate", "failures [%]", 2, PERCENT)
PULL_STEP = Column("pull_step_rms_mm_per_min", "pull step RMS [mm/min]", 4)
RETURN = Column("return", "return", 0)
HEATER_STEP = Column("heater_step_rms_kw", "heater step RMS [kW]", 3)
MEAN_PULL = Column("mean_pull_within_3pct", "30 min mean pull within 3 % [%]", 1, PERCENT)
ERROR = (
    RMSE,
    Column("rmse_observable_mm", "observable RMSE [mm]", 3),
    Column("max_error_mm", "largest error [mm]", 2),
    Column("within_half_mm", "within 0.5 mm [%]", 1, PERCENT),
    FAILURES,
    Column("rmse_survivors_mm", "RMSE of the others [mm]", 3),
    Column("ground_off_pct", "ground off [%]", 2),
)
DRIVES = (
    Column("pull_rms_mm_per_min", "pull RMS [mm/min]", 3),
    PULL_STEP,
    MEAN_PULL,
    HEATER_STEP,
    Column("time_at_limits", "at the drives' limits [%]", 1, PERCENT),
    Column("growth_rate_rms_mm_per_min", "growth rate RMS [mm/min]", 3),
    Column("cost", "cost", 4),
    RETURN,
    Column(SPEED, "compute [us/step]", 2),
)
SHORT = (
    RMSE,
    Column("max_error_mm", "max [mm]", 2, interval=False),
    Column("within_half_mm", "in 0.5 mm [%]", 1, PERCENT, interval=False),
    PULL_STEP._replace(heading="pull step [mm/min]", interval=False),
    HEATER_STEP._replace(heading="heater step [kW]", interval=False),
    FAILURES._replace(interval=False),
    Column(SPEED, "compute [us/step]", 2),
    RMSE._replace(heading=f"RMSE less {REFERENCE}'s [mm]", kind="paired"),
)
"""Columns on a terminal."""
_COMPARISON = (
    RMSE._replace(heading="worst 5 % RMSE [mm]", kind="cvar5"),
    RMSE._replace(heading=f"RMSE less {REFERENCE}'s [mm]", kind="paired"),
    RMSE._replace(heading=f"better than {REFERENCE} with probability", kind="improvement"),
    PULL_STEP._replace(heading=f"pull step RMS less {REFERENCE}'s [mm/min]", kind="paired"),
)
_GAPS = (
    Column("cost", f"optimality gap in cost [% of {REFERENCE}'s]", 3, PERCENT, "gaps"),
    Column("rmse_mm", f"in squared radius error [% of {REFERENCE}'s]", 1, PERCENT, "gaps"),
)


def comparison(result: Result) -> tuple[Column, ...]:
    """Return the columns that compare with the reference on the same crystals, with gaps if there are any."""
    if not result.paired:
        return ()
    return (*_COMPARISON, *(gap for gap in _GAPS if any(gap.metric in known for known in result.gaps.values())))


def label(sample: Sample, result: Result) -> str:
    """Return the contender's name, and how many crystals it met if fewer than the case has."""
    met = len(sample.seeds)
    return sample.name + (f" (n = {met})" if met < len(result.seeds) else "")


def rows(result: Result, columns: Sequence[Column]) -> list[tuple[str, ...]]:
    """Return one row a contender: its label, then the columns' texts."""
    return [
        (label(sample, result), *(column.text(column.estimate(result, sample.name)) for column in columns))
        for sample in result.samples
    ]


WHO = "controller", "reads", "what it is", "training seeds"
"""Heads of :func:`who`."""


def who(samples: Sequence[Sample]) -> list[tuple[str, ...]]:
    """Return one row a contender: what it is, reads and was trained with."""
    contenders = [sample.contender for sample in samples]
    return [
        (each.name, each.observation, each.meaning, ", ".join(map(str, each.training_seeds)) or NOTHING)
        for each in contenders
    ]


def markdown(heads: Iterable[str], rows: Iterable[Iterable[str]], rule: str = "--:") -> str:
    """Return a table in Markdown; ``rule`` is the line under the heads of all columns but the first."""
    grid = [[cell.replace("|", "\\|") for cell in row] for row in (heads, *rows)]
    lines = [f"| {' | '.join(row)} |" for row in grid]
    return "\n".join([lines[0], "|---|" + f"{rule}|" * (len(grid[0]) - 1), *lines[1:]])


def count(number: int, what: str) -> str:
    """Return a number with its noun: "2 scenarios", "1 scenario"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def crystals(number: int) -> str:
    """Return a number of crystals in words: "500 crystals", "1 crystal"."""
    return count(number, "crystal")


def overview(results: Sequence[Result]) -> tuple[tuple[str, ...], dict[str, list[tuple[str, ...]]]]:
    """Return heads, and rows by what contenders knew: RMSE and failures on each scenario, drives on the first."""
    alone = [column._replace(interval=False) for column in (MEAN_PULL, PULL_STEP, HEATER_STEP, RETURN)]
    columns = (RMSE, FAILURES._replace(interval=False), *alone)
    texts = [{name: row for name, *row in rows(result, columns)} for result in results]
    groups: dict[str, list[tuple[str, ...]]] = {}
    for sample in results[0].samples:
        name = label(sample, results[0])
        errors, failures, *others = zip(*(each[name] for each in texts), strict=True)
        line = name, *errors, *(first for first, *_ in others), " / ".join(failures)
        groups.setdefault(sample.contender.knows, []).append(line)
    heads = "controller", *(result.case.name for result in results), *(column.heading for column in alone)
    return (*heads, FAILURES.heading), groups


def deciding(results: Sequence[Result]) -> list[Result]:
    """Return the results on random scenarios, which alone count for a verdict; all if there are none."""
    return [result for result in results if not result.case.deterministic] or list(results)


def too_few(results: Sequence[Result]) -> str:
    """Return that random crystals are too few to say who is better; nothing if they are not."""
    number = len(results[0].seeds)
    few = number < FEWEST and not results[0].case.deterministic
    return f"No verdict: {crystals(number)}, and a verdict needs at least {FEWEST}." if few else ""


def best_of_each_kind(results: Sequence[Result]) -> list[Sample]:
    """Return who has the lowest mean RMSE of those that knew the same, and the user's own; bounds left out."""

    def error(sample: Sample) -> float:
        return sum(result.means[sample.name][RMSE.metric].mean for result in results)

    able = [sample for sample in results[0].samples if not sample.contender.bound]
    best = {sample.contender.knows: sample.name for sample in sorted(able, key=error, reverse=True)}
    return [sample for sample in able if sample.name in best.values() or sample.contender.own]


class Verdict(NamedTuple):
    """Where classical controllers hold the radius best, and where learned agents do."""

    sentence: str
    heads: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    """One a scenario; empty if there is no verdict."""


def verdict(results: Sequence[Result], column: Column = RMSE) -> Verdict:
    """Compare the best classical controller of each scenario with the learned agents, bounds left out.

    ``column`` has the form of the errors. A few crystals of a random scenario give no verdict.
    """
    results = deciding(results)
    groups: dict[str, list[str]] = {}
    for each in (sample.contender for sample in results[0].samples):
        if each.learned and not each.bound:
            groups.setdefault(each.knows, []).append(each.name)
    if not groups:
        return Verdict("No learned agent took part in this run.")
    if results[0].rival is None:
        return Verdict("No classical controller took part in this run to compare the agents with.")
    if few := too_few(results):
        return Verdict(few)
    heads = ["scenario", "best classical [mm]"]
    for group in groups:
        heads += [f"best {group} [mm]", "difference [mm]"]
    where: dict[str, list[str]] = {"a classical controller": [], "a learned agent": [], "": []}
    rows = []
    for result in results:
        errors = {name: means[RMSE.metric] for name, means in result.means.items()}
        won = [name for name in result.verdicts if result.wins(name)]
        best = min(won, key=lambda name: errors[name].mean) if won else str(result.rival)
        row = [f"{result.rival} {column.text(errors[str(result.rival)])}"]
        for names in groups.values():
            name = min(names, key=lambda name: errors[name].mean)
            row += [f"{name} {column.text(errors[name])}", RMSE.text(result.verdicts[name])]
        clear = won or all(map(result.loses, result.verdicts))
        where["a learned agent" if won else "a classical controller" if clear else ""].append(result.case.name)
        rows.append((result.case.name, *row, best if clear else "no difference shown"))
    return Verdict(_sentence(where), (*heads, "lowest error"), tuple(rows))


def _sentence(where: Mapping[str, Sequence[str]]) -> str:
    """Which kind holds the radius best on which scenarios, "" for neither."""
    total = sum(map(len, where.values()))

    def listed(names: Sequence[str]) -> str:
        some = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
        return f"all {total} scenarios" if len(names) == total > 1 else some

    places = {kind: listed(names) for kind, names in where.items() if names}
    held = ", ".join(f"by {kind} on {place}" for kind, place in places.items() if kind)
    if not held:
        return f"No difference is shown between classical controllers and learned agents on {places['']}."
    return f"The radius is held best {held}" + (f"; on {places['']} no difference is shown." if "" in places else ".")
