"""The table of a comparison: means over training seeds and crystals, and differences to a base, paired in both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cz_gym.evaluation.files import csv_text
from cz_gym.evaluation.report.tables import markdown
from cz_gym.evaluation.statistics import Estimate, Resamples, means

from .results import ACTIVITY, COST, FIGURES, LOST, RMSE, TRANSFER, Result
from .variants import Variant

MICRON, PERCENT = 1e-3, 1e-2
"""A micrometre in millimetres, and a hundredth."""
COLUMNS = (
    ("RMSE [um]", RMSE, MICRON, ".1f"),
    ("cost", COST, 1.0, ".4f"),
    ("pull step [um/min]", ACTIVITY, MICRON, ".1f"),
    ("lost [%]", LOST, PERCENT, ".1f"),
    (f"{TRANSFER}: RMSE [um]", f"{TRANSFER}_{RMSE}", MICRON, ".1f"),
    ("lost [%]", f"{TRANSFER}_{LOST}", PERCENT, ".1f"),
)
"""Figures of the table: heading, figure, unit, format."""


class Cell(NamedTuple):
    """One figure of a line."""

    mean: Estimate
    difference: Estimate | None
    """To its base on the same crystals and training seeds; None without one."""


class Line(NamedTuple):
    """One line of the table: a variant."""

    name: str
    base: str
    runs: Mapping[int, Result]
    """By training seed."""
    cells: Mapping[str, Cell]
    """By figure."""

    def trained(self, column: str) -> float:
        """What the runs' progress said at their end, on average over the training seeds."""
        return float(np.mean([run.validations[-1][column] for run in self.runs.values()]))


def tabulate(variants: Sequence[Variant], runs: Mapping[str, Mapping[int, Result]]) -> list[Line]:
    """A line for each variant with finished runs."""
    lines = []
    for name, base in ((variant.name, variant.base) for variant in variants):
        mine, others = runs.get(name, {}), runs.get(base, {})
        if mine:
            values = np.array([run.figures for run in mine.values()])
            weights = Resamples.draw(values.shape[1])
            paired = [run.figures - others[seed].figures for seed, run in mine.items() if seed in others]
            differences = means(np.array(paired), weights) if paired else [None] * len(FIGURES)
            cells = map(Cell, means(values, weights), differences)
            lines.append(Line(name, base, mine, dict(zip(FIGURES, cells, strict=True))))
    return lines


def to_csv(lines: Sequence[Line]) -> str:
    """``table.csv``: a line for each variant and figure."""
    ends = ("mean", "low", "high")
    heads, rows = ("name", "base", "seeds", "crystals", "figure", *ends, *(f"difference_{end}" for end in ends)), []
    for line in lines:
        for figure, cell in line.cells.items():
            numbers = [f"{each:.6g}" for part in cell if part for each in (part.mean, *(part.ci95 or ()))]
            row = (line.name, line.base, " ".join(map(str, line.runs)), cell.mean.n, figure, *numbers)
            rows.append((*row, *[""] * (len(heads) - len(row))))
    return csv_text(heads, rows)


def to_markdown(lines: Sequence[Line]) -> str:
    """The table: means with their intervals, differences beneath them."""
    heads = ("", "seeds", *(head for head, *_ in COLUMNS), "million steps", "minutes")
    rows: list[tuple[str, ...]] = []
    for line in lines:
        ends = f"{1e-6 * line.trained('steps'):.1f}", f"{line.trained('seconds') / 60.0:.0f}"
        figures = [line.cells[figure].mean.text(form, unit) for _, figure, unit, form in COLUMNS]
        rows.append((f"**{line.name}**", str(len(line.runs)), *figures, *ends))
        differences = [(line.cells[figure].difference, unit, form) for _, figure, unit, form in COLUMNS]
        if apart := [difference.text(f"+{form}", unit) for difference, unit, form in differences if difference]:
            rows.append((f"less {line.base}", "", *apart, "", ""))
    return markdown(heads, rows)
