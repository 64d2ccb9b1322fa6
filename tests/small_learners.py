"""Learners that are done in a moment, for tests that need one that has learned something."""

from typing import Any

from cz_gym.agents import recipes
from cz_gym.agents.recipes import APG, PPO, SAC, TrainingConfig, make_algorithm, repeat_of
from cz_gym.agents.train import TrainingRun
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

SMALL = PPO(num_envs=4, action_repeat=2, hidden=(16, 16), steps=128, n_steps=16, batch_size=32, n_epochs=1)
SMALL_SAC = SAC(
    num_envs=4, hidden=(16, 16), steps=256, buffer_size=256, learning_starts=32, batch_size=16, gradient_steps=1
)
SMALL_APG = APG(num_envs=4, window=20, steps=160)
QUICK = PPO(
    num_envs=64, action_repeat=2, steps=32_000_000, n_steps=32, batch_size=1024, n_epochs=1, hidden=(16,),
    fewest_updates=1,
)  # fmt: skip
"""For runs of ``train.py``."""
REFERENCES = dict.fromkeys(recipes.REFERENCES["Cz-v0"], (0.2, 0.1))
TRAIN = TrainingRun.train


def train_small(run: TrainingRun, bar: Any = None) -> dict[str, float]:
    """:meth:`TrainingRun.train` with few validation episodes."""
    recipes.SELECTION_SEEDS, recipes.JUDGING_SEEDS = VALIDATION_SEEDS[:2], VALIDATION_SEEDS[2:4]
    return TRAIN(run, bar)


class SmallRun(TrainingRun):
    """A run with few validation episodes, in any process."""

    train = train_small


def learned(algorithm: Any, recipe: TrainingConfig) -> Any:
    """The algorithm after what is left of the recipe's steps, as a run lets it learn."""
    left = recipe.steps // repeat_of(recipe) - algorithm.num_timesteps
    return algorithm.learn(left, recipe.own_callbacks, reset_num_timesteps=False)


def trained(recipe: TrainingConfig, seed: int = 0) -> Any:
    return learned(make_algorithm(recipe, seed), recipe)
