"""Learners that are done in a moment, for tests that need one that has learned something."""

from typing import Any

from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import PPO, SAC, Recipe
from cz_gym.baselines.registry import make_controller

SMALL = PPO(num_envs=4, hidden=(16, 16), steps=64, n_steps=16, batch_size=32, n_epochs=1)
SMALL_SAC = SAC(
    num_envs=4, hidden=(16, 16), steps=64, buffer_size=256, learning_starts=32, batch_size=16, gradient_steps=1
)


def made(recipe: Recipe, seed: int = 0, done: int = 0) -> Any:
    return make_learner(recipe, seed, make_controller, done=done)


def trained(recipe: Recipe, seed: int = 0) -> Any:
    learner = made(recipe, seed)
    learner.learn(lambda steps, doing: None)
    return learner
