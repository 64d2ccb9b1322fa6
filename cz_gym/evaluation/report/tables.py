"""Texts that every form of the report has: the verdict, and the tables' columns, estimates, numbers and names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cz_gym.evaluation.results import REFERENCE, SPEED, Estimates, Result, Sample
from cz_gym.evaluation.statistics import Estimate
from cz_gym.units import PERCENT

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
        return estimate.text(f"z.{self.decimals}f", self.unit) if estimate else NOTHING


RMSE = Column("rmse_mm", "RMSE [mm]", 3)
FAILURES = Column("failure_rate", "failures [%]", 2, PERCENT)
PULL_STEP = Column("pull_step_rms_mm_per_min", "pull step RMS [mm/min]", 4)
RETURN = Column("return", "return", 0)
HEATER_STEP = Column("heater_step_rms_kw", "heater step RMS [kW]", 3)
ERROR = (
    RMSE,
    Column("rmse_observable_mm", "observable RMSE [mm]", 3),
    Column("max_error_mm", "largest error [mm]", 2),
    Column("within_half_mm", "within 0.5 mm [%]", 1, PERCENT),
    FAILURES,
    Column("ground_off_pct", "ground off [%]", 2),
)
DRIVES = (
    Column("pull_rms_mm_per_min", "pull RMS [mm/min]", 3),
    PULL_STEP,
    Column("mean_pull_within_3pct", "30 min mean pull within 3 % [%]", 1, PERCENT),
    HEATER_STEP,
    Column("time_at_limits", "at the drives' limits [%]", 1, PERCENT),
    Column("growth_rate_rms_mm_per_min", "growth rate RMS [mm/min]", 3),
    Column("cost", "cost", 4),
    RETURN,
    Column(SPEED, "compute [us/step]", 2),
)
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
    return (*_COMPARISON, *(gap for gap in _GAPS if any(gap.metric in found for found in result.gaps.values())))


def label(sample: Sample, result: Result) -> str:
    """Return the contender's name, and how many crystals it met if fewer than the row has."""
    met = len(sample.seeds)
    return sample.name + (f" (n = {met})" if met < len(result.seeds) else "")


def rows(result: Result, columns: Sequence[Column]) -> list[tuple[str, ...]]:
    """Return one row a contender: its label, then the columns' texts."""
    return [
        (label(sample, result), *(column.text(column.estimate(result, sample.name)) for column in columns))
        for sample in result.samples
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


def headline(results: Sequence[Result]) -> str:
    """Return one line: whether the agents win, and where they do not.

    Scenarios of a single crystal do not count, unless there are no others; nor does an agent that is a bound. A few
    crystals of a random scenario give no verdict.
    """
    contenders = [sample.contender for sample in results[0].samples]
    agents = [each.name for each in contenders if each.learned and not each.bound]
    if not agents:
        return "No learned agent took part in this run."
    if results[0].rival is None:
        return "No classical controller took part in this run to compare the agents with."
    deciding = [result for result in results if len(result.seeds) > 1] or list(results)
    if 1 < len(deciding[0].seeds) < FEWEST:
        return f"No verdict: {len(deciding[0].seeds)} crystals, and a verdict needs at least {FEWEST}."
    if always := [agent for agent in agents if all(result.wins(agent) for result in deciding)]:
        first = f"{', '.join(always)} win{'s' if len(always) == 1 else ''} on every scenario."
    else:
        some = any(result.wins(agent) for result in deciding for agent in agents)
        first = "No agent wins on every scenario." if some else "No agent wins."
    return f"{first} {'; '.join(_among(result) for result in deciding)}."


def _among(result: Result) -> str:
    """Comparison of each agent with the best classical controller on one scenario."""
    agents, rival = list(result.verdicts), result.rival

    def named(some: Sequence[str]) -> str:
        return f"all {len(agents)} agents" if len(some) == len(agents) > 1 else ", ".join(some)

    won, lost = list(filter(result.wins, agents)), list(filter(result.loses, agents))
    rest = [agent for agent in agents if agent not in won + lost]
    parts = [f"{named(won)} better than {rival}"] if won else []
    parts += [f"{rival} better than {named(lost)}"] if lost else []
    parts += [f"no clear difference between {rival} and {named(rest)}"] if rest else []
    return f"{result.row.name}: {', '.join(parts)}"
