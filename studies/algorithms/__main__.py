"""Train recipes over several seeds and compare their agents: ``python -m studies.algorithms``.

Every run is an ordinary folder of train.py below ``--work``. A finished run is not trained again, an interrupted one
continues from its checkpoint. All agents are evaluated each time, so a table never mixes figures of different code.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser, between
from cz_gym.errors import CzError
from cz_gym.evaluation.processes import in_processes
from cz_gym.names import unknown

if TYPE_CHECKING:
    from cz_gym.agents.training.recipes import Recipe
    from cz_gym.agents.training.run import Job

    from .report import Result

Perform = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]
"""A function that runs tasks and yields the number of each with its result."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.algorithms", (__doc__ or "").split("\n")[0])
    parser.add_argument("--rows", help="recipes to train, joined by commas (default: all)")
    parser.add_argument(
        "--seeds", type=between(1, 100), default=5, help="training seeds a recipe (default: %(default)s)"
    )
    about = "environment steps (default: the recipe's own)"
    parser.add_argument("--steps", type=between(1, 10**9), help=about)
    parser.add_argument("--jobs", type=between(1, 64), default=2, help="runs at once (default: %(default)s)")
    about = "folder of the %s (default: %%(default)s)"
    parser.add_argument("--out", type=Path, default=Path("results/algorithms"), help=about % "results")
    parser.add_argument("--work", type=Path, default=Path("runs/algorithms"), help=about % "runs")
    return parser.run(_main, arguments, "agents,benchmark", "the same command goes on from the runs' checkpoints")


def _main(given: argparse.Namespace) -> None:
    from cz_gym.agents.training.recipes import RECIPES

    for name in (wanted := given.rows.split(",") if given.rows else [*RECIPES]):
        if name not in RECIPES:
            raise CzError(unknown("row", name, RECIPES))
    recipes = [recipe for name, recipe in RECIPES.items() if name in wanted]
    if given.steps:
        recipes = [replace(each, steps=given.steps) for each in recipes]
    check_writable(given.out)
    jobs = make_jobs(recipes, given.seeds, given.work)
    compare(jobs, given.out, partial(in_processes, processes=given.jobs))


def make_jobs(recipes: Sequence[Recipe], seeds: int, work: Path) -> list[Job]:
    """A run for each training seed and recipe, seed by seed: a stopped comparison has trained every recipe."""
    from cz_gym.agents.training.run import Job

    return [
        Job((work / f"{each.name}-seed{seed}").resolve(), each, seed, {}, command=sys.argv)
        for seed in range(seeds)
        for each in recipes
    ]


def compare(jobs: Sequence[Job], out: Path, perform: Perform) -> None:
    """Train and evaluate the jobs; table and figure are written after each."""
    from .report import report, train_and_evaluate

    results: dict[str, dict[int, Result]] = {job.recipe.name: {} for job in jobs}
    for number, result in perform(train_and_evaluate, jobs):
        job = jobs[number]
        results[job.recipe.name][job.seed] = result
        write_files({out / name: content for name, content in report(results).items()})
        print(f"{job.recipe.name}, seed {job.seed}: done, {out / 'table.md'} is written", flush=True)


if __name__ == "__main__":
    sys.exit(main())
