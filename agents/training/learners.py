"""From a recipe to its learner."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import configure_logger

from cz_gym.config import Config, make_config

from .gradient import GradientLearner
from .imitation import Imitator
from .learner import Learner
from .recipes import Gradient, Imitation, Recipe, Reinforcement
from .reinforcement import Reinforced

Controllers = Callable[[str, Config], Any]
"""Makes a classical controller from its name and an environment's settings."""


def make_learner(
    recipe: Recipe, seed: int, controllers: Controllers, logs: Path | None = None, done: int = 0
) -> Learner:
    """The learner of a recipe for a training seed; ``done`` steps have been taken before (resuming).

    ``logs`` is where TensorBoard's files go; None for none.
    """
    logger = Logger(None, [])
    learner = _learner(recipe, seed, controllers, logger, done)
    if logs:  # made last: a recipe that is refused leaves no folder
        logger.output_formats = configure_logger(0, str(logs), "run", reset_num_timesteps=False).output_formats
    return learner


def _learner(recipe: Recipe, seed: int, controllers: Controllers, logger: Logger, done: int) -> Learner:
    if isinstance(recipe, Imitation):
        config = recipe.config
        measured = make_config(recipe.scenario, control_interval=recipe.control_interval)
        return Imitator(recipe, seed, controllers(recipe.teacher, measured), config, logger, done)
    if isinstance(recipe, Gradient):
        return GradientLearner(recipe, seed, recipe.config, logger, done)
    if isinstance(recipe, Reinforcement):
        return Reinforced(recipe, seed, logger, done)
    raise TypeError(f"no learner learns by a {type(recipe).__name__}")
