"""The ablation's and the algorithms' rows: each changes what it says, and every recipe can be learned."""

from dataclasses import asdict, replace
from typing import Any

import pytest

from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import PPO
from cz_gym.baselines.registry import make_controller
from studies.ablation.rows import ROWS
from studies.algorithms import __main__ as algorithms
from studies.comparison.variants import Variant


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_changes_one_thing(row: Variant) -> None:
    recipes = {each.name: asdict(each.recipe) for each in ROWS}
    base, mine = recipes[row.base or row.name], recipes[row.name]
    assert row.name == "-".join(filter(None, (row.base, row.name.removeprefix(row.base).strip("-"))))
    assert len({name for name in base if base[name] != mine[name]} - {"name"}) == (row.base != "")


def test_rows_are_no_one_s_twin() -> None:
    for rows in (ROWS, algorithms.ROWS):
        assert len({row.name for row in rows}) == len({repr(replace(row.recipe, name="")) for row in rows}) == len(rows)
        assert {row.base for row in rows} <= {"", *(row.name for row in rows)}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_can_be_learned(row: Variant) -> None:
    few: dict[str, Any] = {"n_steps": 8, "batch_size": 32} if isinstance(row.recipe, PPO) else {"window": 8}
    few |= {"steps": 32, "num_envs": 4}
    learner = make_learner(replace(row.recipe, **few), 0, make_controller)
    before = learner.exported()
    learner.learn(lambda steps, doing: None)
    assert learner.steps == learner.total
    assert learner.exported() != before
