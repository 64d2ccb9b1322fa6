"""Training seeds learn on crystals of their own, and a resumed run on new ones; short runs still move the actor."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("sb3_contrib")

from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training.callbacks import CriticFirst
from cz_gym.agents.training.learners import make_training
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config

NAMES = ("ppo", "ppo-scratch", "sac", "ppo-recurrent")


def small(name: str) -> Any:
    choice = settings.RECIPES[name]
    return replace(choice, recipe=replace(choice.recipe, num_envs=8, hidden=(4,)), batch_size=64)


def first_crystals(name: str, seed: int, done: int) -> set[int]:
    teacher = find_controller("lqg").make(make_config("randomized"))
    training = make_training(small(name), seed, None, done, teacher)
    slots = training.learner.env.unwrapped
    given = {int(each) for each in slots._seeds}
    training.learner.env.close()
    return given


@pytest.mark.parametrize("name", NAMES)
def test_no_two_training_seeds_meet_the_same_crystals(name: str) -> None:
    sets = [first_crystals(name, seed, done) for seed, done in ((0, 0), (1, 0), (2, 0), (1, 327_680))]
    assert [len(each) for each in sets] == [8] * 4
    assert len(set.union(*sets)) == 4 * 8


@pytest.mark.parametrize(("steps", "critic"), [(600_000, 200_000), (90_000, 60_000), (3_000_000, 200_000)])
def test_the_critic_never_has_all_of_a_run(steps: int, critic: int) -> None:
    teacher = find_controller("lqg").make(make_config("randomized"))
    training = make_training(replace(small("ppo"), steps=steps), 0, None, 0, teacher)
    (first,) = (each for each in training.callbacks if isinstance(each, CriticFirst))
    assert first.steps == critic
    training.learner.env.close()
