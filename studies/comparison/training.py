"""Training the variants of a comparison, one after the other or some at once; a finished run is never run again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from tqdm import tqdm

from cz_gym.agents.training.learners import config_of
from cz_gym.agents.training.recipes import Recipe
from cz_gym.agents.training.run import CHECKPOINT, Run
from cz_gym.agents.training.validation import Validation
from cz_gym.atomic_files import locked
from cz_gym.baselines.registry import make_controller
from cz_gym.evaluation.cluster import in_processes

from .results import Plan, Result, cached, judge, path_of
from .variants import Variant

Report = Callable[[int, Validation], None]
Task = tuple[Variant, int]
"""A variant and a training seed."""


def trained(
    plan: Plan,
    recipe: Recipe,
    seed: int,
    bar: Any,
    validate_every: int | None = None,
    report: Report = lambda steps, found: None,
) -> Result:
    """What the agent of a recipe and a training seed does on the plan's crystals; trained if that is not cached.

    It goes on from its checkpoint if there is one, which goes when the agent is judged; the rest of its folder stays.
    ``report`` gets what each validation on the way found; what it raises ends the run, whose checkpoint stays.
    """

    def make() -> Result:
        with locked(folder):
            begun = (folder / "settings.json").exists()
            run = Run(folder, recipe, seed, make_controller, resume=begun)
            run.validate_every = validate_every or run.validate_every
            try:
                run.learn(bar, report)
            except KeyboardInterrupt:
                run.save()
                raise
            run.finish()
            rows = [{key: float(value) for key, value in row.items()} for row in run.rows]
            return Result(judge(plan, run.best_policy(), config_of(recipe)), rows)

    name, settings = _identity(recipe, seed)
    folder = plan.work / path_of(plan, name, settings).stem
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


def train_all(plan: Plan, tasks: Sequence[Task], jobs: int, after_each: Callable[[], None]) -> None:
    """Do the runs that are not finished, so many at once."""
    missing = [task for task in tasks if not is_finished(plan, task)]
    print(f"{len(tasks) - len(missing)} runs are done, {len(missing)} to do")
    train = partial(_train, plan)
    several = (said for _, said in in_processes(train, missing, processes=jobs))
    for said in map(train, missing) if jobs == 1 else several:
        print(said, flush=True)
        after_each()


def _train(plan: Plan, task: Task) -> str:
    title = f"{task[0].name}, seed {task[1]}"
    with tqdm(desc=title, unit="step", unit_scale=True, mininterval=1.0, disable=None) as bar:
        trained(plan, task[0].recipe, task[1], bar)
    return f"{title}: done"
