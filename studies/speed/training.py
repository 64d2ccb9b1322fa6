"""What share of a PPO training is spent in environment and adapter: the first updates of train.py's own recipe."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from cz_gym.baselines.registry import make_controller

from .cases import Skipped

NAME = "ppo_share_in_environment"
_UPDATES = 3


def environment_share() -> dict[str, float] | Skipped:
    """Time in the adapter's step over the time that learning takes [-]."""
    try:
        import torch

        from cz_gym.agents.training.learners import make_learner
        from cz_gym.agents.training.recipes import PPO
    except ImportError as error:
        return Skipped(NAME, f"{error.name or error} is not installed")
    threads = torch.get_num_threads()
    try:
        recipe = PPO()
        return {NAME: _measured(make_learner(recipe, 0, make_controller), recipe.n_steps * recipe.num_envs)}
    except Exception as error:  # what training needs must not end the run
        return Skipped(NAME, " ".join(f"{type(error).__name__}: {error}".split())[:100])
    finally:
        torch.set_num_threads(threads)


def _measured(learner: Any, update: int) -> float:
    algorithm, spent = learner.algorithm, 0.0
    algorithm.learn(update)

    def timed(step: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            nonlocal spent
            began = time.perf_counter()
            try:
                return step(*arguments)
            finally:
                spent += time.perf_counter() - began

        return run

    slots = algorithm.env.slots
    slots.step_wait = timed(slots.step_wait)
    began = time.perf_counter()
    algorithm.learn(_UPDATES * update, reset_num_timesteps=False)
    whole = time.perf_counter() - began
    algorithm.env.close()
    return spent / whole
