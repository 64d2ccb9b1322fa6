"""Training the variants of a comparison, one after the other or some at once; a finished run is never run again."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from typing import Any

from tqdm import tqdm

from cz_gym.agents.training.fleet import LOST
from cz_gym.agents.training.recipes import Recipe
from cz_gym.agents.training.run import CHECKPOINT, Run
from cz_gym.atomic_files import locked
from cz_gym.baselines.registry import make_controller

from .results import Plan, Result, cached, judge, path_of
from .variants import Variant

Report = Callable[[Sequence[Mapping[str, Any]]], None]
Task = tuple[Variant, int]
"""A variant and a training seed."""
Perform = Callable[[Callable[[Task], str], Sequence[Task]], Iterator[tuple[int, str]]]
"""Does tasks, here or elsewhere: the number of each and what it said, as they come."""


def trained(
    plan: Plan,
    recipe: Recipe,
    seed: int,
    bar: Any,
    validate_every: int | None = None,
    report: Report = lambda rows: None,
) -> Result:
    """What the agent of a recipe and a training seed does on the plan's crystals; trained if that is not cached.

    It goes on from its checkpoint if there is one, which goes when the agent is judged; the rest of its folder stays.
    ``report`` gets the rows of ``progress.csv`` after each validation on the way.
    """

    def make() -> Result:
        begun = (folder / "settings.json").exists()
        run = Run(folder, recipe, seed, make_controller, resume=begun)
        run.validate_every = validate_every or run.validate_every
        try:
            run.learn(bar, lambda steps, found: report(run.rows))
        except KeyboardInterrupt:
            run.save()
            raise
        run.finish()
        rows = [{key: float(value) for key, value in row.items()} for row in run.rows]
        return Result(judge(plan, run.best_policy(), recipe.config), rows)

    name, settings = _identity(recipe, seed)
    path = path_of(plan, name, settings)
    folder = plan.work / path.stem
    # A machine that was given up may still be at work: what it finishes is not done again.
    with nullcontext() if path.exists() else locked(folder, LOST):
        result = cached(plan, name, settings, make)
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return result


def _identity(recipe: Recipe, seed: int) -> tuple[str, Any]:
    return f"{recipe.name}-seed{seed}", {"seed": seed, "recipe": json.loads(json.dumps(asdict(recipe)))}


def is_finished(plan: Plan, task: Task) -> bool:
    """Whether a task's result is cached."""
    return path_of(plan, *_identity(task[0].recipe, task[1])).exists()


def result_of(plan: Plan, task: Task) -> Result:
    """The cached result of a finished task."""
    return trained(plan, task[0].recipe, task[1], None)


def train_all(plan: Plan, tasks: Sequence[Task], perform: Perform, after_each: Callable[[], None]) -> None:
    """Do the runs that are not finished."""
    missing = [task for task in tasks if not is_finished(plan, task)]
    print(f"{len(tasks) - len(missing)} runs are done, {len(missing)} to do")
    for _, said in perform(partial(_train, plan, sys.argv), missing):
        print(said, flush=True)
        after_each()


def in_turn(function: Callable[[Task], str], tasks: Sequence[Task]) -> Iterator[tuple[int, str]]:
    """One task after the other, here."""
    return enumerate(map(function, tasks))


def _train(plan: Plan, command: Sequence[str], task: Task) -> str:
    sys.argv = list(command)
    title = f"{task[0].name}, seed {task[1]}"
    with tqdm(desc=title, unit="step", unit_scale=True, mininterval=1.0, disable=None) as bar:
        trained(plan, task[0].recipe, task[1], bar)
    return f"{title}: done"
