"""The ablation's table: means over training seeds and crystals, and paired differences to the base row.

Every row meets the same crystals and the same training seeds, and a seed's runs begin with the same imitation where
their settings let them. So a difference is taken crystal by crystal and seed by seed; its interval resamples both.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.agents.training.validation import JUDGING
from cz_gym.evaluation.statistics import Estimate, Resamples, means
from studies.comparison.lqg_family import Rivals, rivals_table
from studies.comparison.runs import FARTHER, FIGURES, STAGES, Finished

from .rows import BASE, Row

Floats = npt.NDArray[np.float64]
MILLI = 1e-3
MICRON = 1e-3
"""A micrometre in millimetres."""
FEW = 0.01
"""Share of lost crystals up to which radius errors are compared at equal activity: lost ones would be most of it."""
SHOWN = "best"
"""The agent that the table's first columns show: a recipe keeps the one that did best on validation."""


class Cell(NamedTuple):
    """One figure of one stage of a row."""

    mean: Estimate
    difference: Estimate | None
    """To the base row's best agent on the same crystals and training seeds; None without it."""


@dataclass(frozen=True)
class Line:
    """One row of the table."""

    row: Row
    seeds: tuple[int, ...]
    cells: Mapping[tuple[str, str], Cell]
    """By stage and figure."""


def tabulate(
    rows: Sequence[Row], runs: Mapping[str, Sequence[Finished]], resamples: Resamples | None = None
) -> list[Line]:
    """A line for each row with finished runs; rows about the same thing stand together."""
    if not runs:
        return []
    weights = resamples or Resamples.draw(len(next(iter(runs.values()))[0].stages[SHOWN]))
    base = {run.seed: run.stages[SHOWN] for run in runs.get(BASE, ())}
    subjects = list(dict.fromkeys(row.about for row in rows))
    ordered = sorted(rows, key=lambda row: subjects.index(row.about))
    return [_line(row, runs[row.name], base, weights) for row in ordered if row.name in runs]


def _line(row: Row, runs: Sequence[Finished], base: Mapping[int, Floats], resamples: Resamples) -> Line:
    cells: dict[tuple[str, str], Cell] = {}
    for stage in STAGES:
        if not all(stage in run.stages for run in runs):
            continue
        values = np.array([run.stages[stage] for run in runs])
        paired = [run.stages[stage] - base[run.seed] for run in runs if run.seed in base]
        found = means(values, resamples)
        apart = means(np.array(paired), resamples) if paired else (None,) * len(FIGURES)
        for name, mean, difference in zip(FIGURES, found, apart, strict=True):
            cells[stage, name] = Cell(mean, difference)
    return Line(row, tuple(run.seed for run in runs), cells)


def to_csv(lines: Sequence[Line]) -> str:
    """``table.csv``: a line for each row, stage and figure."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    ends = ("mean", "low", "high")
    heading = (
        "row",
        "about",
        "training_seeds",
        "crystals",
        "agent",
        "figure",
        *ends,
        *(f"difference_{e}" for e in ends),
    )
    writer.writerow(heading)
    for line in lines:
        for (stage, figure), cell in line.cells.items():
            seeds = " ".join(map(str, line.seeds))
            numbers = [f"{number:.6g}" if number is not None else "" for each in cell for number in _numbers(each)]
            writer.writerow((line.row.name, line.row.about, seeds, cell.mean.n, stage, figure, *numbers))
    return text.getvalue()


def _numbers(estimate: Estimate | None) -> tuple[float | None, ...]:
    if estimate is None:
        return None, None, None
    return estimate.mean, *(estimate.ci95 or (None, None))


def to_markdown(lines: Sequence[Line], steps: int, lqgs: Rivals) -> str:
    """``table.md``."""
    most = max((len(line.seeds) for line in lines), default=0)
    return "\n".join(
        [
            "# What helps: one change of `PPO()` at a time",
            "",
            f"{steps:,} environment steps a run, up to {most} training seeds a row, judged on {len(JUDGING)} "
            f"validation crystals of `randomized` (seeds {JUDGING[0]:,} to {JUDGING[-1]:,}) that select nothing. "
            "In brackets: 95 % intervals, bootstrap over training seeds and crystals; differences are to `base` "
            "on the same crystals and training seeds, negative is better. *Kept* is the agent of least cost on "
            "the validation that selects, as the recipe does it; *last* is what learning ended with; *start* is "
            "what it began as: the imitation, or the controller that the network's action is added to. With so "
            "few training seeds the intervals are somewhat too narrow. *At equal activity*: RMSE of the kept "
            "agents over what the LQG's frontier has at their pull step RMS, by means; 1 is as good.",
            "",
            *_table(lines, lqgs),
            "",
            "| row | what is changed |",
            "|---|---|",
            *(f"| {line.row.name} | {line.row.meaning} |" for line in lines),
            "",
            "The LQG's settings on the same crystals:",
            "",
            *rivals_table(lqgs),
            "",
        ]
    )


def _table(lines: Sequence[Line], lqgs: Rivals) -> list[str]:
    headings = (
        "row", "seeds", "RMSE kept [um]", "at equal activity", "difference [um]", "RMSE last [um]", "RMSE start [um]",
        "1000 cost kept", "difference", "last", "start", "1000 reward's cost kept", "difference",
        "pull step kept [mm/min]", "lost kept / last [%]", f"{FARTHER}: RMSE kept [um]", "lost [%]",
    )  # fmt: skip
    found = [f"| {' | '.join(headings)} |", f"|---|{'--:|' * (len(headings) - 1)}"]
    for line in lines:
        kept, lost = {name: line.cells[SHOWN, name] for name in FIGURES}, line.cells["last", "failure_rate"].mean
        start, began = line.cells.get(("start", "rmse_mm")), line.cells.get(("start", "cost"))
        entries = (
            line.row.name,
            str(len(line.seeds)),
            _interval(kept["rmse_mm"].mean, MICRON, 1),
            at_equal_activity(line, lqgs),
            _interval(kept["rmse_mm"].difference, MICRON, 1, True),
            f"{line.cells['last', 'rmse_mm'].mean.mean / MICRON:.1f}",
            f"{start.mean.mean / MICRON:.1f}" if start else "-",
            _interval(kept["cost"].mean, MILLI, 2),
            _interval(kept["cost"].difference, MILLI, 2, True),
            f"{line.cells['last', 'cost'].mean.mean / MILLI:.2f}",
            f"{began.mean.mean / MILLI:.2f}" if began else "-",
            f"{kept['reward_cost'].mean.mean / MILLI:.2f}",
            _interval(kept["reward_cost"].difference, MILLI, 2, True),
            f"{kept['pull_step_rms_mm_per_min'].mean.mean:.4f}",
            f"{100.0 * kept['failure_rate'].mean.mean:.1f} / {100.0 * lost.mean:.1f}",
            _interval(kept[f"{FARTHER}_rmse_mm"].mean, MICRON, 1),
            f"{100.0 * kept[f'{FARTHER}_failure_rate'].mean.mean:.1f}",
        )
        found.append(f"| {' | '.join(entries)} |")
    return found


def at_equal_activity(line: Line, lqgs: Rivals) -> str:
    """RMSE of a row's kept agents over the LQG's where it is as active, "-" where none is or crystals are lost."""
    figures = "rmse_mm", "pull_step_rms_mm_per_min", "failure_rate"
    rmse, activity, lost = (line.cells[SHOWN, name].mean.mean for name in figures)
    ratio = lqgs.ratio(rmse, activity) if lost <= FEW else None
    return "-" if ratio is None else f"{ratio:.2f}"


def _interval(estimate: Estimate | None, unit: float, digits: int, signed: bool = False) -> str:
    if estimate is None or (signed and estimate.mean == 0.0 and estimate.ci95 == (0.0, 0.0)):
        return "-"
    sign = "+" if signed else ""
    ends = ", ".join(f"{end / unit:{sign}.{digits}f}" for end in estimate.ci95 or ())
    return f"{estimate.mean / unit:{sign}.{digits}f}" + (f" [{ends}]" if ends else "")
