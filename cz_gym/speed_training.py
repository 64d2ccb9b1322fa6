"""What share of a PPO training is spent in environment and adapter: the first updates of train.py's own learner."""

from __future__ import annotations

import time
from typing import Any

from .speed_cases import Skipped
from .speed_peers import agents_module

NAME = "ppo_share_in_environment"
_UPDATES = 3


def environment_share() -> dict[str, float] | Skipped:
    """Time in the environment's step, its adapter and the reward's wrapper, over the time that learning takes [-]."""
    try:
        torch = agents_module("network").torch
        make_training, settings = agents_module("training").make_training, agents_module("settings")
    except ImportError as error:
        return Skipped(NAME, f"{error.name or error} is not installed")
    threads = torch.get_num_threads()
    try:
        return {NAME: _measured(make_training(settings.SCRATCH, 0, None), settings.SCRATCH)}
    except Exception as error:  # what training needs must not end the run
        return Skipped(NAME, " ".join(f"{type(error).__name__}: {error}".split())[:100])
    finally:
        torch.set_num_threads(threads)


def _measured(training: Any, choice: Any) -> float:
    learner, update = training.learner, choice.n_steps * choice.recipe.num_envs
    learner.learn(update, callback=training.callbacks)
    step, spent = learner.env.step, 0.0

    def timed(actions: Any) -> Any:
        nonlocal spent
        began = time.perf_counter()
        try:
            return step(actions)
        finally:
            spent += time.perf_counter() - began

    learner.env.step = timed
    began = time.perf_counter()
    learner.learn(_UPDATES * update, callback=training.callbacks, reset_num_timesteps=False)
    whole = time.perf_counter() - began
    learner.env.close()
    return spent / whole
