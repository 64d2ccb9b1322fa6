"""What share of a PPO training is spent in environment and adapter: the first updates of train.py's own recipe."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config

from .cases import Skipped

NAME = "ppo_share_in_environment"
_UPDATES = 3


def environment_share() -> dict[str, float] | Skipped:
    """Time in the adapter's step and in the twin that rewards are compared with, over the time that learning takes [-].

    What the teacher computes on the twin is no environment's, nor is imitating it before.
    """
    try:
        import torch

        from cz_gym.agents.training import recipes as settings
        from cz_gym.agents.training.learners import make_training
    except ImportError as error:
        return Skipped(NAME, f"{error.name or error} is not installed")
    threads = torch.get_num_threads()
    try:
        choice = settings.PPO()
        teacher = find_controller(choice.recipe.clone.teacher).make(make_config())
        return {NAME: _measured(make_training(choice, 0, None, 0, teacher), choice)}
    except Exception as error:  # what training needs must not end the run
        return Skipped(NAME, " ".join(f"{type(error).__name__}: {error}".split())[:100])
    finally:
        torch.set_num_threads(threads)


def _measured(training: Any, choice: Any) -> float:
    learner, update = training.learner, choice.n_steps * choice.recipe.num_envs
    learner.learn(update, callback=training.callbacks)
    paired, spent = learner.env, 0.0

    def timed(step: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            nonlocal spent
            began = time.perf_counter()
            try:
                return step(*arguments)
            finally:
                spent += time.perf_counter() - began

        return run

    paired.slots.step_wait = timed(paired.slots.step_wait)
    paired.twin.step = timed(paired.twin.step)
    began = time.perf_counter()
    learner.learn(_UPDATES * update, callback=training.callbacks, reset_num_timesteps=False)
    whole = time.perf_counter() - began
    learner.env.close()
    return spent / whole
