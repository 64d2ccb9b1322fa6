"""The ablation's and the algorithms' rows: each changes what it says, and every recipe can be learned."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import pytest
from stable_baselines3.common.logger import Logger

from cz_gym.agents.training.imitation import Imitator
from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import PPO, RECIPES, Imitation
from cz_gym.baselines.registry import find_controller, make_controller
from cz_gym.config import make_config
from studies.ablation.rows import ROWS
from studies.algorithms import __main__ as algorithms
from studies.comparison.variants import Variant

CHANGES = {
    "imitation-untold": {"teacher"},
    "imitation-quarter": {"episodes"},
    "imitation-no-wide": {"wide_share"},
    "imitation-all-wide": {"wide_share"},
    "imitation-width-1.5": {"width"},
    "imitation-rounds-1": {"rounds", "episodes"},
    "imitation-rounds-3": {"rounds", "episodes"},
    "imitation-memory-none": {"memory"},
    "imitation-memory-4min": {"memory"},
    "imitation-small": {"hidden"},
    "imitation-linear": {"hidden"},
    "imitation-heater-too": {"loss_weights"},
    "ppo-absolute": {"head"},
    "ppo-blind-critic": {"privileged_critic"},
    "ppo-memory-none": {"memory"},
    "ppo-memory-4min": {"memory"},
    "ppo-linear": {"hidden"},
    "ppo-gamma-0.98": {"gamma"},
    "ppo-little-noise": {"noise"},
    "ppo-teachers-cost": {"weights"},
}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_changes_what_it_says_and_nothing_else(row: Variant) -> None:
    assert (row.base == "") == (row.name in RECIPES)
    base, mine = asdict(RECIPES[row.base or row.name]), asdict(row.recipe)
    assert {name for name in base if base[name] != mine[name]} - {"name"} == CHANGES.get(row.name, set())
    if isinstance(row.recipe, Imitation):
        assert find_controller(row.recipe.teacher).told == (row.name != "imitation-untold")
        crystals = row.recipe.rounds * row.recipe.episodes
        assert crystals == (960 if row.name == "imitation-quarter" else 3840)


def test_rows_have_names_of_their_own() -> None:
    assert {row.name for row in ROWS} == set(CHANGES) | {"imitation", "ppo"}
    assert len(ROWS) == len(CHANGES) + 2
    assert [row.name for row in algorithms.ROWS] == ["ppo", "ppo-recurrent", "sac", "imitation"]
    assert all(row.recipe == RECIPES[row.name] for row in algorithms.ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_can_be_learned(row: Variant) -> None:
    learner: Any
    if isinstance(row.recipe, Imitation):
        few = replace(row.recipe, teacher="lqg", rounds=1, episodes=4, epochs=1)
        config = make_config("randomized", observation="history", horizon=100.0)
        learner = Imitator(few, 0, make_controller("lqg", make_config("randomized")), config, Logger(None, []), 0)
    else:
        assert isinstance(row.recipe, PPO)
        learner = make_learner(replace(row.recipe, steps=32, num_envs=4, n_steps=8, batch_size=32), 0, make_controller)
    before = learner.exported()
    learner.learn(lambda steps, doing: None)
    assert learner.steps == learner.total
    assert learner.exported() != before
