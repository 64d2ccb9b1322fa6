"""What the search turns of the ``ppo`` recipe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from cz_gym.agents.training.recipes import PPO

Params = Mapping[str, Any]
"""A place in the space, by the names of :data:`SPACE`."""
SPACE: dict[str, BaseDistribution] = {
    "learning_rate": FloatDistribution(1e-4, 4e-3, log=True),
    "gae_lambda": FloatDistribution(0.5, 0.99),
    "clip_range": FloatDistribution(0.03, 0.4, log=True),
    "n_steps": CategoricalDistribution((16, 32, 64, 128, 256)),
    "batch_size": CategoricalDistribution((512, 1024, 2048, 4096, 8192)),
    "n_epochs": IntDistribution(1, 10),
    "horizon": FloatDistribution(10.0, 500.0, log=True),
    "noise": FloatDistribution(0.05, 1.0, log=True),
}
"""Fields of the recipe; but ``horizon`` is 1 / (1 - gamma) in steps."""


def params_of(recipe: PPO) -> dict[str, Any]:
    """Where a recipe stands in the space."""
    own = {name: getattr(recipe, name) for name in SPACE if hasattr(recipe, name)}
    return {**own, "horizon": 1.0 / (1.0 - recipe.gamma)}


def recipe_of(params: Params, steps: int, name: str) -> PPO:
    """The recipe at a place in the space, learning for so many environment steps."""
    own = {key: value for key, value in params.items() if hasattr(PPO(), key)}
    return replace(PPO(), name=name, steps=steps, gamma=1.0 - 1.0 / params["horizon"], **own)
