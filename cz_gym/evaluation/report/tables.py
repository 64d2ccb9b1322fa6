"""What every table of results shares: its columns, the estimates in them, and how numbers are written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from cz_gym.evaluation.results import REFERENCE, SPEED, Outcome, ScenarioResult
from cz_gym.evaluation.statistics import Estimate
from cz_gym.units import PERCENT

NOTHING = "-"


class Column(NamedTuple):
    """A column of a table: by default the mean of a metric."""

    metric: str
    heading: str
    decimals: int
    unit: float = 1.0
    """The table's unit in the metric's own."""
    find: Callable[[Outcome], Estimate | None] | None = None
    """The estimate, where it is not the mean of ``metric``."""

    def estimate(self, outcome: Outcome) -> Estimate | None:
        """The column's estimate of an outcome in the metric's unit; None where there is none."""
        return self.find(outcome) if self.find else outcome.means[self.metric]

    def text(self, estimate: Estimate | None) -> str:
        """The mean in the column's unit, with its interval if it has one."""
        return estimate.text(f"z.{self.decimals}f", self.unit) if estimate else NOTHING


RMSE = Column("rmse_mm", "RMSE [mm]", 3)
FAILURES = Column("failure_rate", "failures [%]", 1, PERCENT)
PULL_STEP = Column("pull_step_rms_mm_per_min", "pull step RMS [mm/min]", 4)
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
    Column("growth_rate_rms_mm_per_min", "growth rate RMS [mm/min]", 3),
    Column("cost", "cost", 4),
    Column("return", "return", 0),
    Column(SPEED, "compute [us/step]", 2),
)
_COMPARISON = (
    Column("rmse_mm", "worst 5 % RMSE [mm]", 3, find=lambda outcome: outcome.cvar5["rmse_mm"]),
    Column("rmse_mm", f"RMSE less {REFERENCE}'s [mm]", 3, find=lambda outcome: outcome.paired.get("rmse_mm")),
    Column("rmse_mm", f"better than {REFERENCE} with probability", 3, find=lambda outcome: outcome.improvement),
    PULL_STEP._replace(
        heading=f"pull step RMS less {REFERENCE}'s [mm/min]", find=lambda outcome: outcome.paired.get(PULL_STEP.metric)
    ),
)
_GAPS = (
    Column("cost", f"optimality gap in cost [% of {REFERENCE}'s]", 3, PERCENT, lambda outcome: outcome.gap),
    Column("rmse_mm", f"in squared radius error [% of {REFERENCE}'s]", 1, PERCENT, lambda outcome: outcome.gap_radius),
)


def comparison(scenario: ScenarioResult) -> tuple[Column, ...]:
    """Columns that compare with the reference on the same crystals, empty without it; gaps where there are some."""
    if not any(outcome.paired for outcome in scenario.outcomes):
        return ()
    gaps = (gap for gap in _GAPS if any(gap.estimate(outcome) for outcome in scenario.outcomes))
    return (*_COMPARISON, *gaps)


def label(outcome: Outcome, scenario: ScenarioResult) -> str:
    """The controller's name, and how many crystals it met if fewer than the scenario has."""
    met = len(outcome.sample.seeds)
    return outcome.controller.name + (f" (n = {met})" if met < len(scenario.seeds) else "")


def rows(scenario: ScenarioResult, columns: Sequence[Column]) -> list[tuple[str, ...]]:
    """One row a controller: its label, then the columns' texts."""
    return [
        (label(outcome, scenario), *(column.text(column.estimate(outcome)) for column in columns))
        for outcome in scenario.outcomes
    ]


def markdown(heads: Iterable[str], rows: Iterable[Iterable[str]], rule: str = "--:") -> str:
    """A table in Markdown; ``rule`` is the line under the heads of all columns but the first."""
    first, *others = heads
    lines = [f"| {' | '.join(row)} |" for row in ((first, *others), *rows)]
    return "\n".join([lines[0], "|---|" + f"{rule}|" * len(others), *lines[1:]])


def count(number: int, what: str) -> str:
    """ "2 scenarios", "1 scenario"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def crystals(number: int) -> str:
    """ "500 crystals", "1 crystal"."""
    return count(number, "crystal")
