"""Trained agents side by side, several training seeds each: ``python -m studies.algorithms RUNS``.

``RUNS`` are folders of ``train.py``: of one run, or of ``--seeds``. Every agent is evaluated on every random scenario;
``--out`` receives the table and the learning curves.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.errors import CzError
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.processes import in_processes
from cz_gym.evaluation.protocol import ROWS
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
ABOUT = """RMSE of the radius on {crystals} validation crystals of each scenario that did not choose a run's agent; of
each run the agent of least cost on the validation that selects. Lost: share of all these crystals. Cost and pull step:
on `{scenario}`. In brackets: 95 % intervals, bootstrap over training seeds and crystals; with few training seeds they
are somewhat too narrow. Differences are taken on the same crystals and training seeds, negative is better."""


class Result(NamedTuple):
    """Figures of one training run."""

    name: str
    """Name of the agent."""
    seed: int
    figures: Floats
    """Figures of :data:`COLUMNS` on the validation crystals that chose no agent, shape (crystals, figures)."""
    progress: Sequence[Mapping[str, float]]
    """Rows of the run's ``progress.csv``."""


def evaluate(folder: Path) -> Result:
    """Evaluate the agent of a finished run."""
    from cz_gym.agents import load
    from cz_gym.agents.training import validation
    from cz_gym.agents.training.run_files import read_rows

    agent = load(folder / "agent.onnx")
    configs = [make_config(name, **agent.settings) for name in SCENARIOS]
    found = [metrics(rollout(agent, config, validation.JUDGING)) for config in configs]
    lost = np.mean([each.failure_rate for each in found], axis=0)
    columns = *(each.rmse_mm for each in found), lost, found[0].cost, found[0].pull_step_rms_mm_per_min
    rows = [{name: float(value) for name, value in row.items()} for row in read_rows(folder / "progress.csv")]
    return Result(agent.contract.algorithm, agent.contract.training_seed, np.stack(columns, axis=-1), rows)


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
    from cz_gym.agents.training.plot import curves
    from cz_gym.agents.training.run_files import to_csv

    lines = tabulate(results)
    crystals = len(next(iter(lines[0].runs.values())).figures)
    about = ABOUT.format(crystals=crystals, scenario=SCENARIOS[0])
    title = "# Algorithms side by side: the recipes of train.py on the same crystals"
    text = "\n".join([title, "", about, "", to_markdown(lines), ""])
    progress = {name: [run.progress for run in runs.values()] for name, runs in results.items()}
    rows = [
        {"variant": name, "seed": seed, **row}
        for name, runs in results.items()
        for seed, run in runs.items()
        for row in run.progress
    ]
    return {"table.md": text.encode(), "curves.png": curves(progress), "curves.csv": to_csv(rows)}


def tabulate(results: Results) -> list[Line]:
    """A line for each recipe with results."""
    lines = []
    for name, mine in results.items():
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.algorithms", (__doc__ or "").split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="folder of a finished run of train.py, or of several")
    about = "folder of the results (default: %(default)s)"
    parser.add_argument("--out", type=Path, default=Path("results/algorithms"), help=about)
    return parser.run(_compare, arguments, "agents,benchmark")


def _compare(given: argparse.Namespace) -> None:
    check_writable(given.out)
    folders = sorted(path.parent for runs in given.runs for path in runs.glob("**/summary.json"))
    if not folders:
        raise CzError(f"no finished run of train.py in {', '.join(map(str, given.runs))}")
    found = dict(in_processes(evaluate, folders))
    results: dict[str, dict[int, Result]] = {}
    for each in (found[number] for number in range(len(folders))):
        results.setdefault(each.name, {})[each.seed] = each
    write_files({given.out / name: content for name, content in report(results).items()})
    print(f"wrote {given.out / 'table.md'}")


if __name__ == "__main__":
    sys.exit(main())
