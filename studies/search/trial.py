"""One trial of the search: the recipe with its knobs turned learns for a while from a kept imitation."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.agents.training.recipes import PPO, CostWeights
from cz_gym.agents.training.run import Run
from cz_gym.agents.training.validation import PICKING, costs
from cz_gym.baselines.registry import make_controller
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout

Floats = npt.NDArray[np.float64]
CHOOSE = VALIDATION_SEEDS[len(PICKING) :][:150]
"""Seeds of the crystals that trials are judged on; those that a run looks at on its way are none of them."""
CONFIRM = VALIDATION_SEEDS[len(PICKING) :][150:350]
"""Seeds of the crystals that the best trials are judged on again, with other training seeds."""
LOOKS = 6
"""Validations on the way of a trial."""


class Given(Exception):
    """A trial was given up."""


class Tried(NamedTuple):
    """What a trial found: cost and RMSE [mm] of each crystal, shape (crystals, 2), and the costs on its way."""

    last: Floats
    start: Floats
    course: tuple[float, ...]
    """Less that of the imitation, after each look."""
    seconds: float


class _TrialRun(Run):
    """A run that tells what each validation found, so that it can be given up."""

    tell: Callable[[int, float], None] = staticmethod(lambda look, cost: None)

    def _validate(self, bar: Any) -> None:
        super()._validate(bar)
        course = costs_so_far(self)
        if course:
            self.tell(len(course), course[-1])


def costs_so_far(run: Run) -> tuple[float, ...]:
    """Validation costs less that of the imitation, in order."""
    found = [float(row["validation_cost"]) for row in run.rows]
    return tuple(cost - found[0] for cost in found[1:])


def attempt(
    choice: PPO,
    seed: int,
    judged: Sequence[int],
    work: Path,
    tell: Callable[[int, float], None] = lambda look, cost: None,
) -> Tried:
    """Train those settings and judge what came out; ``tell(look, cost)`` may raise :class:`Given`."""
    began, folder = time.monotonic(), work / "trial"
    shutil.rmtree(folder, ignore_errors=True)
    recipe = choice.recipe
    run = _TrialRun(folder, choice, seed, make_controller, imitations=work / "imitations")
    run.validate_every = max(choice.steps // LOOKS, 1)
    run.tell = tell  # type: ignore[method-assign]
    try:
        run.learn(_Quiet())
        seen = make_config(recipe.scenario, observation=recipe.observation)
        last, start = (_judged(p, seen, judged, recipe.weights) for p in (run.present_policy(), run.first_policy()))
    finally:
        run.training.learner.env.close()
        shutil.rmtree(folder, ignore_errors=True)
    return Tried(last, start, costs_so_far(run), time.monotonic() - began)


def _judged(policy: Any, config: Config, seeds: Sequence[int], weights: CostWeights) -> Floats:
    found = metrics(rollout(policy, config, seeds))
    return np.stack([costs(found, weights), found.rmse_mm], axis=-1)


class _Quiet:
    """A progress bar that shows nothing."""

    n = 0

    def update(self, count: int) -> None:
        """Count."""
        self.n += count

    def set_postfix_str(self, text: str) -> None:
        """Say nothing."""
