"""Tables of the report: filters and pivots of a benchmark's estimates, as texts of numbers with their intervals."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cz_gym.evaluation.protocol import REFERENCE, Case, Contender
from cz_gym.evaluation.statistics import Estimate
from cz_gym.support.units import PERCENT

if TYPE_CHECKING:
    from cz_gym.evaluation.plots import Style
    from cz_gym.tools.episodes import Benchmark

NOTHING = "-"
ERRORS = 1e-6, 1e3
"""Range of the errors that :func:`typical` compares [mm]."""
NAMED = 8
"""Most controllers with a look of their own in a figure."""
PIDS = "pid-uncompensated", "pid-conventional", "paper-filtered"
"""Controllers that the result shows beside the best: what a reader knows as a PID, and the paper's where noise is."""
FEWEST = 20
"""Least number of crystals for a verdict on a scenario with randomness."""
Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Heads and rows."""
Groups = tuple[tuple[str, ...], dict[str, list[tuple[str, ...]]]]
"""Heads, and rows by what controllers know of the plant."""


class Column(NamedTuple):
    """Heading and form of the estimates of one metric and kind (:data:`cz_gym.tools.episodes.ESTIMATES`)."""

    metric: str
    heading: str
    decimals: int
    unit: float = 1.0
    """Unit of the column, in units of the metric."""
    kind: str = "mean"
    interval: bool = True
    """True if the intervals are shown."""

    def text(self, estimate: Estimate | None) -> str:
        """Return the mean in the column's unit, with its interval if it has one that is shown."""
        if estimate and not (self.interval and estimate.ends[0] == estimate.ends[0]):  # NaN: of too few crystals
            estimate = estimate._replace(ci95=None)
        known = estimate and estimate.mean == estimate.mean  # NaN: the metric does not apply
        return estimate.text(f"z.{self.decimals}f", self.unit) if estimate and known else NOTHING

    def of(self, benchmark: "Benchmark", case: Case, name: str) -> str:
        """Return the text of a controller on a scenario."""
        return self.text(benchmark.get(case, name, self.metric, self.kind))


RMSE = Column("rmse_mm", "RMSE [mm]", 3)
FAILURES = Column("failure_rate", "failures [%]", 2, PERCENT)
PULL_STEP = Column("pull_step_rms_mm_per_min", "pull step RMS [mm/min]", 4)
COST = Column("cost", "cost", 4)
RETURN = Column("return", "return", 0)
HEATER_STEP = Column("heater_step_rms_kw", "heater step RMS [kW]", 3)
MEAN_PULL = Column("mean_pull_within_3pct", "30 min mean pull within 3 % [%]", 1, PERCENT)
COMPARISON = (
    RMSE._replace(heading="worst 5 % RMSE [mm]", kind="cvar"),
    RMSE._replace(heading=f"RMSE less {REFERENCE}'s [mm]", kind="difference"),
    RMSE._replace(heading=f"better than {REFERENCE} with probability", kind="improvement"),
    PULL_STEP._replace(heading=f"pull step RMS less {REFERENCE}'s [mm/min]", kind="difference"),
    Column("cost", f"optimality gap in cost [% of {REFERENCE}'s]", 3, PERCENT, "gap"),
    Column("rmse_mm", f"in squared radius error [% of {REFERENCE}'s]", 1, PERCENT, "gap"),
)
"""Columns that compare with the reference on the same crystals, and gaps."""
WHO = "controller", "reads", "what it is", "training seeds"
"""Heads of :func:`who`."""
ROBUSTNESS = "pull's effect up to", "down to", "extra delay [s]"
ROBUSTNESS_MEANS = (
    "Robustness is measured: the pull moves the crystal that many times as much as asked for (1 is exact), or both "
    "drives act that much later, no crystal is lost, and the mean radius error at most doubles; readings show what was "
    "asked for. Marks for at least and at most stand where the grid ends."
)
"""Meaning of :data:`ROBUSTNESS`."""


def comparison(benchmark: "Benchmark", case: Case) -> tuple[Column, ...]:
    """Return the columns of :data:`COMPARISON` for a scenario: none without the reference, gaps if there are any."""
    frame = benchmark.estimates[benchmark.estimates["scenario"] == case.name]
    if not (frame["kind"] == "difference").any():
        return ()
    gaps = set(frame.loc[frame["kind"] == "gap", "metric"])
    return tuple(column for column in COMPARISON if column.kind != "gap" or column.metric in gaps)


def label(benchmark: "Benchmark", case: Case, name: str) -> str:
    """Return the controller's name, and how many crystals it met if fewer than others."""
    met = len(benchmark.seeds(case, name))
    return name + (f" (n = {met})" if met < len(benchmark.seeds(case)) else "")


def rows(benchmark: "Benchmark", case: Case, columns: Sequence[Column]) -> list[tuple[str, ...]]:
    """Return one row a controller: its label, then the columns' texts."""
    names = [each.name for each in benchmark.contenders]
    return [(label(benchmark, case, name), *(column.of(benchmark, case, name) for column in columns)) for name in names]


def who(benchmark: "Benchmark") -> Table:
    """Return heads, and one row a contender: what it is, reads and was trained with, and its robustness if measured."""
    found = benchmark.robustness
    rows = [
        (
            *(each.name, each.observation, each.meaning, ", ".join(map(str, each.training_seeds)) or NOTHING),
            *((NOTHING,) * len(ROBUSTNESS) if each.own else found.get(each.name, (NOTHING,) * len(ROBUSTNESS))),
        )
        for each in benchmark.contenders
    ]
    return ((*WHO, *ROBUSTNESS), rows) if found else (WHO, [row[: len(WHO)] for row in rows])


def beyond(value: float, end: float) -> str:
    """Return a figure of a search on a grid, marked if it is the grid's end."""
    return ("" if value != end else "≥ " if end > 1.0 else "≤ ") + f"{value:.3g}"


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


def deciding(benchmark: "Benchmark") -> tuple[Case, ...]:
    """Return the random scenarios, which alone count for a verdict; all if there are none."""
    return tuple(case for case in benchmark.cases if not case.deterministic) or benchmark.cases


def too_few(benchmark: "Benchmark") -> str:
    """Return that random crystals are too few to say who is better; nothing if they are not."""
    first = deciding(benchmark)[0]
    number = len(benchmark.seeds(first))
    few = number < FEWEST and not first.deterministic
    return f"No verdict: {crystals(number)}, and a verdict needs at least {FEWEST}." if few else ""


def best_of_each_kind(benchmark: "Benchmark") -> list[Contender]:
    """Return who ranks first of those that knew the same, and the user's own; bounds left out."""
    able, cases = [each for each in benchmark.contenders if not each.bound], deciding(benchmark)
    ranked = sorted(able, key=lambda each: benchmark.rank(cases, each.name), reverse=True)
    best = {each.knows: each.name for each in ranked}
    return [each for each in able if each.name in best.values() or each.own]


def firsts(benchmark: "Benchmark") -> list[Contender]:
    """Return who ranks first, over the first two deciding scenarios, of the agents and of the classical controllers
    that are not told the scenario, in order, and on each of the two of those that are.

    Shorter where such controllers did not take part; bounds left out.
    """
    cases = deciding(benchmark)[:2]
    able = [each for each in benchmark.contenders if not each.bound]
    told = [each for each in able if each.told]
    kinds = [[each for each in able if not each.told and each.learned is learned] for learned in (True, False)]
    found = [min(kind, key=lambda each: benchmark.rank(cases, each.name)) for kind in kinds if kind]
    found.sort(key=lambda each: benchmark.rank(cases, each.name))
    return [*found, *(min(told, key=lambda each: benchmark.rank([case], each.name)) for case in cases if told)]


def closest(benchmark: "Benchmark") -> Contender:
    """Return who has the least radius error on the first deciding scenario; bounds left out where others took part."""
    case, able = deciding(benchmark)[0], [each for each in benchmark.contenders if not each.bound]
    return min(able or benchmark.contenders, key=lambda each: benchmark.mean(case, each.name, RMSE.metric))


def in_one_look(benchmark: "Benchmark", more: Sequence[str] = ()) -> list[Contender]:
    """Return, in their order, those of :func:`chosen`, those whom the finding names, and ``more``."""
    named = *firsts(benchmark), closest(benchmark)
    names = [each.name for each in (*chosen(benchmark, deciding(benchmark)[0], NAMED), *named)]
    return [each for each in benchmark.contenders if each.name in (*names, *more)]


def in_player(benchmark: "Benchmark", case: Case) -> list[Contender]:
    """Return, in their order, those whose :func:`typical` crystal the player shows."""
    return in_one_look(benchmark, [*PIDS, *(each.name for each in chosen(benchmark, case, NAMED))])


def typical(benchmark: "Benchmark", case: Case) -> int:
    """Return the place of the crystal that pictures show: of those that all met, the one on which no controller of
    :func:`chosen` is far from its usual error, by the largest ratio of its RMSE and its median.
    """
    names = [each.name for each in chosen(benchmark, case, NAMED)]
    met = min(len(benchmark.seeds(case, name)) for name in names)
    errors = np.stack([benchmark.values(case, name, RMSE.metric)[0, :met] for name in names])
    logs = np.log(np.clip(np.nan_to_num(errors, nan=np.inf), *ERRORS))
    return int(np.abs(logs - np.median(logs, axis=1, keepdims=True)).max(axis=0).argmin())


def looks_of(benchmark: "Benchmark") -> "dict[str, Style]":
    """Return the look of each controller; those that figures show first have colours of their own."""
    from cz_gym.evaluation.plots import STYLES, styles  # tables need no matplotlib

    shown = [each.name for each in chosen(benchmark, deciding(benchmark)[0], NAMED)]
    names = [each.name for each in benchmark.contenders]
    ranked = sorted(names, key=lambda name: (name not in shown, name not in STYLES))
    return styles(ranked, [each.name for each in benchmark.contenders if each.learned])


def chosen(benchmark: "Benchmark", case: Case, most: int) -> list[Contender]:
    """Return at most ``most`` of the controllers, in their order, for a figure that has no room for all.

    Preferred are the reference, the user's own, the best agent, quoted controllers, other agents, other controllers,
    bounds; within a group those that rank first on the scenario.
    """
    ranked = sorted(benchmark.contenders, key=lambda each: benchmark.rank([case], each.name))
    learned = [each.name for each in ranked if each.learned and not each.bound]

    def place(each: Contender) -> tuple[bool, ...]:
        first = each.name != REFERENCE, not each.own, each.name not in learned[:1], not each.quoted
        return *first, each.bound, not each.learned

    names = [each.name for each in sorted(ranked, key=place)[:most]]
    return [each for each in benchmark.contenders if each.name in names]
