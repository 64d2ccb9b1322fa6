"""From a recipe to its learner."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import configure_logger

from .gradient import GradientLearner
from .imitation import Imitator
from .learner import Learner
from .recipes import Gradient, Imitation, Recipe, Reinforcement
from .reinforcement import ReinforcementLearner


def make_learner(recipe: Recipe, seed: int, teacher: Any = None, logs: Path | None = None, done: int = 0) -> Learner:
    """The learner of a recipe for a training seed; a resumed one has taken ``done`` steps before.

    An :class:`.recipes.Imitation` needs its teacher. ``logs`` is the folder of TensorBoard's files; None: none.
    """
    logger = Logger(None, [])
    learner: Learner
    match recipe:
        case Imitation():
            learner = Imitator(recipe, seed, teacher, recipe.config, logger, done)
        case Gradient():
            learner = GradientLearner(recipe, seed, recipe.config, logger, done)
        case Reinforcement():
            learner = ReinforcementLearner(recipe, seed, logger, done)
        case _:
            raise TypeError(f"no learner for a {type(recipe).__name__}")
    if logs:  # made last: a recipe that is refused leaves no folder
        logger.output_formats = configure_logger(0, str(logs), "run", reset_num_timesteps=False).output_formats
    return learner
