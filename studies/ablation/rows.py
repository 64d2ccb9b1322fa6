"""The rows of the ablation: each is ``PPO()``, the recipe that ``ppo`` grew from, with one thing changed.

But for ``scratch``, and for ``told``, ``some-wide`` and ``more-shown``, which lead step by step to what ships.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cz_gym.agents.training.recipes import PPO, RECIPES, SCRATCH, ActionHead, Choice, Clone, CostWeights, Recipe
from cz_gym.units import MINUTE

BASE = "base"
"""Name of the row that the others are compared with."""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    about: str
    """What was changed: rows about the same thing stand together."""
    meaning: str
    """One line for people."""
    choice: Choice
    share: float = 1.0
    """Of the steps that rows are trained for [-]."""

    def of(self, steps: int) -> Choice:
        """Its settings when rows are trained for that many environment steps."""
        return replace(self.choice, steps=round(self.share * steps))


_PPO = PPO()
_RECIPE = _PPO.recipe
_TEACHER = _RECIPE.clone or Clone("lqg")


def _recipe(recipe: Recipe) -> PPO:
    return replace(_PPO, recipe=recipe)


def _weights(weight: float) -> Row:
    changed = replace(_RECIPE, weights=CostWeights(weight, weight))
    meaning = f"pull and pull step weigh {weight:g} instead of {_RECIPE.weights.pull:g}"
    return Row(f"weights-{weight:g}", "reward", meaning, _recipe(changed))


def _teacher(name: str) -> Row:
    changed = replace(_RECIPE, clone=replace(_TEACHER, teacher=name))
    return Row(f"teacher-{name}", "beginning", f"imitates {name} instead of {_TEACHER.teacher}", _recipe(changed))


def _residual(name: str, controller: str) -> Row:
    beside = replace(_TEACHER, teacher=controller, rounds=1)
    changed = replace(_RECIPE, clone=beside, residual=True, head=replace(_RECIPE.head, skip=0.0))
    return Row(f"residual-{name}", "action", f"the network's action is added to {controller}'s", _recipe(changed))


def _memory(name: str, memory: float, meaning: str) -> Row:
    return Row(f"memory-{name}", "memory", meaning, _recipe(replace(_RECIPE, memory=memory)))


def _width(name: str, width: float, meaning: str) -> Row:
    return Row(f"pullers-{name}", "pullers", meaning, _recipe(replace(_RECIPE, width=width)))


def _shown(name: str, width: float, meaning: str) -> Row:
    changed = replace(_RECIPE, clone=replace(_TEACHER, width=width))
    return Row(f"shown-{name}", "beginning", meaning, _recipe(changed))


_SHIPS = RECIPES["ppo"].recipe.clone or _TEACHER
_TOLD = replace(_SHIPS, rounds=6, width=1.0, wide_share=1.0, epochs=6)
_MORE_SHOWN = replace(_TOLD, teacher=_TEACHER.teacher)
_FROM_NOTHING = replace(SCRATCH, recipe=replace(SCRATCH.recipe, weights=_RECIPE.weights))

_ROWS = (
    Row(BASE, BASE, f"imitates {_TEACHER.teacher}, then PPO; for all the steps", _PPO),
    Row("fifth", BASE, "a fifth of the steps", _PPO, share=0.2),
    Row(
        "told",
        "beginning",
        f"a fifth of the steps; imitates {_TOLD.teacher}, shown {_TOLD.rounds * _TOLD.episodes:,} crystals spread as"
        " the scenario's own",
        _recipe(replace(_RECIPE, clone=_TOLD)),
        share=0.2,
    ),
    Row(
        "some-wide",
        "beginning",
        f"the same, but shown {_SHIPS.rounds * _SHIPS.episodes:,} crystals in {_SHIPS.epochs} epochs a round instead of"
        f" {_TOLD.epochs}, {_SHIPS.wide_share:.0%} of them spread {_SHIPS.width:g} times as wide: what ships",
        _recipe(replace(_RECIPE, clone=_SHIPS)),
        share=0.2,
    ),
    Row(
        "more-shown",
        "beginning",
        f"as told, but imitates {_MORE_SHOWN.teacher}",
        _recipe(replace(_RECIPE, clone=_MORE_SHOWN)),
        share=0.2,
    ),
    Row("scratch", "beginning", "no imitation: ppo-scratch's settings, the same reward", _FROM_NOTHING),
    Row(
        "absolute",
        "action",
        "the network sets the drives instead of moving them",
        _recipe(replace(_RECIPE, head=ActionHead(skip=0.0))),
    ),
    Row(
        "blind-critic",
        "critic",
        "the critic sees what the actor sees",
        _recipe(replace(_RECIPE, privileged_critic=False)),
    ),
    Row("unpaired", "critic", "the teacher's reward is not taken off", replace(_PPO, paired=False)),
    Row("heater-free", "what learns", "the heater's outputs learn too", replace(_PPO, frozen=("layers",))),
    Row("actor-pace-1", "what learns", "the actor learns at the critic's rate", replace(_PPO, actor_pace=1.0)),
    _shown("1", 1.0, "the imitation is shown crystals spread as the scenario's own, not twice as wide"),
    _residual("lqg", _TEACHER.teacher),
    _residual("paper", "paper"),
    _memory("none", 0.0, "no past samples: what is measured now, and the integral"),
    _memory("4min", 4.0 * MINUTE, "past samples up to 4 min old, not 20"),
    _weights(0.5),
    _weights(1.0),
    _width("nominal", 0.0, "imitates and learns on one puller, halfway between Models I and II"),
    _width("wider", 1.5, "parameters of pullers spread 1.5 times as wide"),
    _teacher("lqg"),
    Row("layers-free", "what learns", "the hidden layers learn too", replace(_PPO, frozen=("heater",))),
    Row("all-free", "what learns", "heater and hidden layers learn too", replace(_PPO, frozen=())),
    Row("no-critic-first", "critic", "critic and actor learn from the first step", replace(_PPO, critic_steps=0)),
    _teacher("lqg-quiet"),
    _shown("1.5", 1.5, "the imitation is shown crystals spread one and a half times as wide"),
    _width("half", 0.5, "parameters of pullers spread half as wide"),
    Row("on-hard", "pullers", "imitates, learns and is selected on hard", _recipe(replace(_RECIPE, scenario="hard"))),
)
ROWS: tuple[Row, ...] = tuple(replace(row, choice=replace(row.choice, name=f"ppo-{row.name}")) for row in _ROWS)
"""Every row, those that say most first; its agents are called by its name."""


def find_rows(names: Sequence[str]) -> tuple[Row, ...]:
    """The rows of those names, in the table's order; ValueError names what there is."""
    known = {row.name for row in ROWS}
    for name in names:
        if name not in known:
            raise ValueError(f"unknown row {name!r}; choose from {', '.join(row.name for row in ROWS)}")
    return tuple(row for row in ROWS if row.name in names)
