"""The rows of the ablation: the recipes ``ppo`` and ``imitation`` as they stand, and each with one thing changed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from cz_gym.agents.training.recipes import RECIPES, Recipe
from cz_gym.units import MINUTE
from studies.comparison.variants import Variant

PPO, IMITATION = RECIPES["ppo"], RECIPES["imitation"]


def _changed(base: Recipe, name: str, meaning: str, **changes: Any) -> Variant:
    return Variant(replace(base, name=f"{base.name}-{name}", **changes), meaning, base.name)


def _ppo(name: str, meaning: str, **changes: Any) -> Variant:
    return _changed(PPO, name, meaning, **changes)


def _imitation(name: str, meaning: str, **changes: Any) -> Variant:
    return _changed(IMITATION, name, meaning, **changes)


ROWS = (
    Variant(PPO, "from nothing, by reward; smooth actions, differences of the past, a critic that sees the true state"),
    _ppo("rate", "an action moves the drives from where they are: no return to nominal", action="rate"),
    _ppo("direct", "an action sets the drives, within their whole range", action="direct"),
    _ppo("means", "means of past spans as they are, not their differences", basis="means"),
    _ppo("memory-none", "no past samples: what is measured now, and the integral", memory=0.0),
    _ppo("memory-4min", "past samples up to 4 min old, not 20", memory=4.0 * MINUTE),
    _ppo("alive-bonus", "every step earns, and a lost crystal costs nothing but the steps left", failure_costs=False),
    _ppo("gamma-0.95", "a horizon of 20 steps, not of 100", gamma=0.95),
    _ppo("gamma-0.998", "a horizon of 500 steps", gamma=0.998),
    _ppo("lambda-0.8", "a shorter advantage window, 5 steps", gae_lambda=0.8),
    _ppo("lambda-0.99", "a longer advantage window, 100 steps", gae_lambda=0.99),
    _ppo("little-noise", "exploration begins with a fifth of the spread", noise=0.1),
    _ppo("much-noise", "exploration begins with twice the spread", noise=1.0),
    _ppo("blind-critic", "the critic sees what the actor sees", privileged_critic=False),
    _ppo("interval-10s", "a control interval of 10 s, not of 5", control_interval=10.0),
    _ppo("half-crystals", "crystals of 1.5 h while it learns, not of 3 h", length=5400.0),
    _ppo("linear", "no hidden layers", hidden=()),
    Variant(IMITATION, "no reward: its teacher, lqg-at-0.02-told, knows each crystal's puller and roughness"),
    _imitation("plain-teacher", "the teacher is lqg-at-0.02, which is not privileged", teacher="lqg-at-0.02"),
    _imitation("no-wide", "no wide crystals, all spread as the scenario's own", wide_share=0.0),
    _imitation("rounds-1", "all crystals in one round: the teacher drives them all", rounds=1, episodes=3840),
    _imitation("linear", "no hidden layers", hidden=()),
)
"""Every row, in the table's order; its agents are called by its name."""
