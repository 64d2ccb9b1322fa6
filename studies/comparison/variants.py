"""What a comparison is made of: recipes beside a base, and the question that they answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from cz_gym.agents.training.recipes import Recipe, Rewarded
from cz_gym.errors import CzError
from cz_gym.names import unknown


@dataclass(frozen=True)
class Variant:
    """One line of a comparison."""

    recipe: Recipe
    meaning: str
    """One line for people."""
    base: str = ""
    """Name of the variant that it is compared with; empty for one that is compared with none."""

    @property
    def name(self) -> str:
        """What its agents are called."""
        return self.recipe.name

    def of(self, steps: int | None) -> Variant:
        """The same, learning for that many environment steps if it learns from reward; None: its recipe's own."""
        if steps is None or not isinstance(self.recipe, Rewarded):
            return self
        return replace(self, recipe=replace(self.recipe, steps=steps))


class Study(NamedTuple):
    """A question that a comparison answers."""

    name: str
    """Of its module, and of its folders in ``results`` and ``runs``."""
    title: str
    """One line for people."""
    variants: Sequence[Variant]
    steps: int | None
    """Environment steps of variants that learn from reward, unless told otherwise; None: their recipes' own."""

    def names(self, wanted: str | None) -> list[str]:
        """The names of all variants, or of those wanted, joined by commas; ValueError names what there is."""
        known = [variant.name for variant in self.variants]
        names = known if wanted is None else wanted.split(",")
        for name in names:
            if name not in known:
                raise CzError(unknown("row", name, known))
        return names
