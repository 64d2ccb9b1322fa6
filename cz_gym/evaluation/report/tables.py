"""Columns of the tables of results, the estimates in them, and the format of numbers and names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cz_gym.evaluation.results import REFERENCE, SPEED, Estimates, Result, Sample
from cz_gym.evaluation.statistics import Estimate
from cz_gym.units import PERCENT

NOTHING = "-"


class Column(NamedTuple):
    """A column of a table: a metric of one of a result's kinds of estimates."""

    metric: str
    heading: str
    decimals: int
    unit: float = 1.0
    """The table's unit in the metric's own."""
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
FAILURES = Column("failure_rate", "failures [%]", 1, PERCENT)
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
    """Return "2 scenarios", "1 scenario"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def crystals(number: int) -> str:
    """Return "500 crystals", "1 crystal"."""
    return count(number, "crystal")
