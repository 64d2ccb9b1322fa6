"""The rows of the ablation: the recipes ``imitation`` and ``ppo`` as they stand, and each with one thing changed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from cz_gym.agents.training.recipes import PPO, RECIPES, ActionHead, Recipe
from cz_gym.units import MINUTE
from studies.comparison.variants import Variant

IMITATION, FROM_NOTHING = RECIPES["imitation"], PPO()


def _changed(base: Recipe, name: str, meaning: str, **changes: Any) -> Variant:
    return Variant(replace(base, name=f"{base.name}-{name}", **changes), meaning, base.name)


def _imitation(name: str, meaning: str, **changes: Any) -> Variant:
    return _changed(IMITATION, name, meaning, **changes)


def _ppo(name: str, meaning: str, **changes: Any) -> Variant:
    return _changed(FROM_NOTHING, name, meaning, **changes)


ROWS = (
    Variant(IMITATION, "its teacher, lqg-at-0.02-told, is privileged: it knows each crystal's puller and roughness"),
    _imitation("plain-teacher", "the teacher is lqg-at-0.02, which is not privileged", teacher="lqg-at-0.02"),
    _imitation("quarter", "a quarter of the crystals", episodes=120),
    _imitation("no-wide", "no wide crystals, all spread as the scenario's own", wide_share=0.0),
    _imitation("all-wide", "all crystals are wide", wide_share=1.0),
    _imitation("width-1.5", "wide crystals are spread 1.5 times as wide, not twice", width=1.5),
    _imitation("rounds-1", "all crystals in one round: the teacher drives them all", rounds=1, episodes=3840),
    _imitation("rounds-3", "the same number of crystals in three rounds", rounds=3, episodes=1280),
    _imitation("memory-none", "no past samples: what is measured now, and the integral", memory=0.0),
    _imitation("memory-4min", "past samples up to 4 min old, not 20", memory=4.0 * MINUTE),
    _imitation("small", "hidden layers of 32 units, not of 128", hidden=(32, 32)),
    _imitation("linear", "no hidden layers", hidden=()),
    _imitation("heater-too", "the heater's output is fitted by gradient as well", loss_weights=(1.0, 1.0)),
    Variant(FROM_NOTHING, "PPO from nothing; the critic also sees the true state"),
    _ppo("absolute", "the network sets the drives instead of moving them", head=ActionHead(skip=0.0)),
    _ppo("blind-critic", "the critic sees what the actor sees", privileged_critic=False),
    _ppo("memory-none", "no past samples: what is measured now, and the integral", memory=0.0),
    _ppo("memory-4min", "past samples up to 4 min old, not 20", memory=4.0 * MINUTE),
    _ppo("linear", "no hidden layers", hidden=()),
    _ppo("gamma-0.98", "a horizon of 50 steps, not of 100", gamma=0.98),
    _ppo("little-noise", "exploration begins with a fifth of the spread", noise=(0.01, 0.01)),
    _ppo("teachers-cost", "learns for the cost that imitation's teacher was made for", weights=IMITATION.weights),
)
"""Every row, in the table's order; its agents are called by its name."""
