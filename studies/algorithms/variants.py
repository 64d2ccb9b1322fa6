"""The recipes that are compared: every recipe of train.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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


ALGORITHMS = (
    Variant(
        RECIPES["gradient"],
        "analytic policy gradients from nothing: the cost's gradient through policy and plant, which is known",
    ),
    Variant(RECIPES["ppo"], "proximal policy optimisation from nothing"),
    Variant(RECIPES["sac"], "soft actor-critic from nothing; it learns with actions of 20 s", "ppo"),
)
COMPARISONS = {
    "algorithms": Comparison("Algorithms side by side: the recipes of train.py on the same crystals", ALGORITHMS),
}
