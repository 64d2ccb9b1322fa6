"""Evaluation of trained agents on every random scenario, and the table and learning curves of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.agents.training import validation
from cz_gym.agents.training.fleet import train_seed
from cz_gym.agents.training.run import Job
from cz_gym.agents.training.run_files import read_rows, to_csv
from cz_gym.agents.training.validation import REFERENCES, references
from cz_gym.baselines.registry import make_controller
from cz_gym.config import Config
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import ROWS
from cz_gym.evaluation.report.canvas import INK, canvas, png, styles
from cz_gym.evaluation.report.tables import markdown
from cz_gym.evaluation.rollout import Floats, rollout
from cz_gym.evaluation.statistics import Estimate, Resamples, means

BASE = "ppo"
"""Recipe that the others are compared with."""
SCENARIOS = tuple(row.name for row in ROWS if row.default and not find_scenario(row.scenario).deterministic)
"""Scenarios of the crystals that judge every agent; cost and pull step are of the first."""
MICRON, PERCENT = 1e-3, 1e-2
"""A micrometre in millimetres, and a hundredth."""
COLUMNS = (
    *((f"{name} [um]", MICRON, ".1f") for name in SCENARIOS),
    ("lost [%]", PERCENT, ".2f"),
    ("cost", 1.0, ".4f"),
    ("pull step [um/min]", MICRON, ".1f"),
)
"""Heading, unit and format of each figure of :func:`evaluate`."""
AXES = (("steps", 1e6, "environment steps [million]"), ("seconds", 60.0, "minutes on a core, validation included"))
"""Horizontal axes of the learning curves: column of a run's progress, unit, label."""
ABOUT = """RMSE of the radius on {crystals} validation crystals of each scenario that did not choose a run's agent; of
each run the agent of least cost on the validation that selects. Lost: share of all these crystals. Cost and pull step:
on `{scenario}`. In brackets: 95 % intervals, bootstrap over training seeds and crystals; with few training seeds they
are somewhat too narrow. Differences are taken on the same crystals and training seeds, negative is better."""


class Result(NamedTuple):
    """Figures of one training run."""

    figures: Floats
    """Figures as :func:`evaluate` returns them, shape (crystals, figures)."""
    progress: Sequence[Mapping[str, float]]
    """Rows of the run's ``progress.csv``."""


def train_and_evaluate(job: Job) -> Result:
    """Train a run to its end, from its checkpoint if there is one, and evaluate its best agent."""
    if job.summary is None:
        train_seed(job._replace(references=references(make_controller, job.recipe)))
    config = job.recipe.config
    rows = [{name: float(value) for name, value in row.items()} for row in read_rows(job.folder / "progress.csv")]
    return Result(evaluate(OnnxPolicy.load(job.folder / "agent.onnx", config), config), rows)


def evaluate(policy: Any, config: Config) -> Floats:
    """Figures of :data:`COLUMNS` on the validation crystals that chose no agent, shape (crystals, figures)."""
    found = [metrics(rollout(policy, config.with_scenario(name), validation.JUDGING)) for name in SCENARIOS]
    lost = np.mean([each.failure_rate for each in found], axis=0)
    columns = *(each.rmse_mm for each in found), lost, found[0].cost, found[0].pull_step_rms_mm_per_min
    return np.stack(columns, axis=-1)


Results = Mapping[str, Mapping[int, Result]]
"""Results by recipe and training seed."""


class Line(NamedTuple):
    """Figures of one recipe, and their differences to :data:`BASE` if that has been trained."""

    name: str
    runs: Mapping[int, Result]
    means: tuple[Estimate, ...]
    differences: tuple[Estimate, ...]


def report(results: Results) -> dict[str, bytes]:
    """``table.md``, ``curves.png`` and ``curves.csv``, by file name."""
    lines = tabulate(results)
    about = ABOUT.format(crystals=len(validation.JUDGING), scenario=SCENARIOS[0])
    title = "# Algorithms side by side: the recipes of train.py on the same crystals"
    text = "\n".join([title, "", about, "", to_markdown(lines), ""])
    rows = [
        {"variant": name, "seed": seed, **row}
        for name, runs in results.items()
        for seed, run in runs.items()
        for row in run.progress
    ]
    return {"table.md": text.encode(), "curves.png": curves(lines), "curves.csv": to_csv(rows)}


def tabulate(results: Results) -> list[Line]:
    """A line for each recipe with results."""
    lines = []
    for name, mine in ((name, runs) for name, runs in results.items() if runs):
        others = results.get(BASE, {}) if name != BASE else {}
        values = np.array([run.figures for run in mine.values()])
        weights = Resamples.draw(values.shape[1])
        paired = [run.figures - others[seed].figures for seed, run in mine.items() if seed in others]
        lines.append(Line(name, mine, means(values, weights), means(np.array(paired), weights) if paired else ()))
    return lines


def to_markdown(lines: list[Line]) -> str:
    """Means with their intervals, differences beneath them."""
    rows: list[tuple[str, ...]] = []
    for line in lines:
        last = [run.progress[-1] for run in line.runs.values()]
        spent = (
            f"{1e-6 * np.mean([row['steps'] for row in last]):.1f}",
            f"{np.mean([row['seconds'] for row in last]) / 60:.0f}",
        )
        figures = (each.text(form, unit) for each, (_, unit, form) in zip(line.means, COLUMNS, strict=True))
        rows.append((f"**{line.name}**", str(len(line.runs)), *figures, *spent))
        if line.differences:
            apart = (
                each.text(f"+{form}", unit) for each, (_, unit, form) in zip(line.differences, COLUMNS, strict=True)
            )
            rows.append((f"less {BASE}", "", *apart, "", ""))
    return markdown(("", "seeds", *(head for head, *_ in COLUMNS), "million steps", "minutes"), rows)


def curves(lines: list[Line]) -> bytes:
    """Validation RMSE while learning against steps and minutes, a line a training seed, as PNG.

    Dashed: the classical controllers on the same crystals.
    """
    figure = canvas(9.4, 4.6)
    panels = figure.subplots(1, 2, sharey=True)
    style, last = styles([line.name for line in lines]), next(iter(lines[0].runs.values())).progress[-1]
    for axis, (column, unit, title) in zip(panels, AXES, strict=True):
        for line in lines:
            for place, run in enumerate(line.runs.values()):
                spent = [row[column] / unit for row in run.progress]
                error = [row["validation_rmse_mm"] for row in run.progress]
                look = {"color": style[line.name].colour, "marker": style[line.name].marker}
                label = line.name if place == 0 and axis is panels[0] else None
                axis.plot(spent, error, ms=2.5, lw=1.0, label=label, **look)
        for name in REFERENCES:
            rmse = last[f"{name}_rmse_mm"]
            axis.axhline(rmse, color=INK, lw=0.9, ls="--")
            if axis is panels[0]:
                axis.annotate(name, (0.99, rmse), (0, 2), axis.get_yaxis_transform(), textcoords="offset points",
                              ha="right", fontsize=8, color=INK)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=title)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter(lambda value, position: f"{value:g}")
    panels[0].set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle("Radius error on validation crystals while learning: a line a training seed", fontsize=11)
    return png(figure)
