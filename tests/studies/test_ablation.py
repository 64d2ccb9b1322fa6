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


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_changes_one_thing(row: Variant) -> None:
    """But for the number of rounds, which leaves the number of crystals as it is."""
    base, mine = asdict(RECIPES[row.base or row.name]), asdict(row.recipe)
    changed = {name for name in base if base[name] != mine[name]} - {"name"}
    assert row.name == "-".join(filter(None, (row.base, row.name.removeprefix(row.base).strip("-"))))
    assert changed == {"rounds", "episodes"} or len(changed) == (row.base != "")
    if isinstance(row.recipe, Imitation):
        assert find_controller(row.recipe.teacher).privileged == ("teacher" not in changed)
        assert row.recipe.rounds * row.recipe.episodes == (960 if changed == {"episodes"} else 3840)


def test_rows_are_no_one_s_twin() -> None:
    for rows in (ROWS, algorithms.ROWS):
        assert len({row.name for row in rows}) == len({repr(replace(row.recipe, name="")) for row in rows}) == len(rows)
        assert {row.base for row in rows} <= {"", *(row.name for row in rows)}


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
