"""The recipes that are compared: every recipe of train.py, and ``ppo`` with one thing changed at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from cz_gym.agents.training.recipes import RECIPES, Recipe


@dataclass(frozen=True)
class Variant:
    """One row of a comparison: a recipe that is trained over several seeds."""

    recipe: Recipe
    meaning: str
    """What the recipe does, in one line."""
    base: str = ""
    """Name of the row that it is compared with; empty for none."""

    @property
    def name(self) -> str:
        """Name of the recipe and of its agents."""
        return self.recipe.name


class Comparison(NamedTuple):
    """Rows that answer one question."""

    title: str
    variants: tuple[Variant, ...]


PPO: Any = replace(RECIPES["ppo"], steps=1_500_000)


def _ppo(name: str, meaning: str, **changes: Any) -> Variant:
    return Variant(replace(PPO, name=f"ppo-{name}", **changes), meaning, "ppo")


ALGORITHMS = (
    Variant(
        RECIPES["gradient"],
        "analytic policy gradients from nothing: the cost's gradient through policy and plant, which is known; of its "
        "crystals, 65 % are of hard, sensor-fault and puller",
    ),
    Variant(RECIPES["ppo"], "proximal policy optimisation from nothing; the critic also sees the true state"),
    Variant(RECIPES["sac"], "soft actor-critic from nothing; both see the past; it learns with actions of 20 s", "ppo"),
)
ABLATION = (
    Variant(PPO, "from nothing, by reward; smooth actions, differences of the past, a critic that sees the true state"),
    _ppo("rate", "an action moves the drives from where they are: no return to nominal", action="rate"),
    _ppo("direct", "an action sets the drives, within their whole range", action="direct"),
    _ppo("alive-bonus", "every step earns, and a lost crystal costs nothing but the steps left", failure_costs=False),
    _ppo("gamma-0.95", "a horizon of 20 steps, not of 100", gamma=0.95),
    _ppo("gamma-0.998", "a horizon of 500 steps", gamma=0.998),
    _ppo("lambda-0.8", "a shorter advantage window, 5 steps", gae_lambda=0.8),
    _ppo("lambda-0.99", "a longer advantage window, 100 steps", gae_lambda=0.99),
    _ppo("little-noise", "exploration begins with a fifth of the spread", noise=0.1),
    _ppo("much-noise", "exploration begins with twice the spread", noise=1.0),
    _ppo("blind-critic", "the critic sees what the actor sees", privileged_critic=False),
    _ppo("interval-10s", "a control interval of 10 s, not of 5", control_interval=10.0),
    _ppo("linear", "no hidden layers", hidden=()),
)
COMPARISONS = {
    "algorithms": Comparison("Algorithms side by side: the recipes of train.py on the same crystals", ALGORITHMS),
    "ablation": Comparison("What helps ppo: one change at a time, after 1.5 million steps", ABLATION),
}
