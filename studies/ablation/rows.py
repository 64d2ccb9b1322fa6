"""The rows of the ablation: the recipes ``gradient-start``, ``gradient-specialist`` and ``ppo``, cut short, and each
with one thing changed.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from cz_gym.agents.training.recipes import OWN_WEIGHTS, RECIPES, Gradient, Recipe
from cz_gym.units import MINUTE
from studies.comparison.variants import Variant

GRADIENT: Any = replace(RECIPES["gradient-start"], steps=350 * Gradient.num_envs * Gradient.window)  # type: ignore[call-arg]
"""An eighth of the recipe: it holds every crystal, and what helps shows."""
SPECIALIST: Any = replace(RECIPES["gradient-specialist"], steps=GRADIENT.steps, weights=GRADIENT.weights)  # type: ignore[call-arg]
PPO: Any = replace(RECIPES["ppo"], steps=1_500_000)  # type: ignore[call-arg]


def _changed(base: Recipe, name: str, meaning: str, **changes: Any) -> Variant:
    return Variant(replace(base, name=f"{base.name}-{name}", **changes), meaning, base.name)


_gradient, _specialist, _ppo = (partial(_changed, base) for base in (GRADIENT, SPECIALIST, PPO))
ROWS = (
    Variant(
        GRADIENT,
        "from nothing, by the cost's exact gradient; a law scheduled on noise, ripple, swings, reference and age",
    ),
    _gradient("unscheduled", "one linear map for all crystals, beside the tanh layer", scheduled=False),
    _gradient("linear", "no tanh layer beside the scheduled map", hidden=()),
    _gradient("own-crystals", "crystals of its own scenario alone, none wide or of others", also=()),
    _gradient("window-5min", "gradients through 5 minutes, not 15; three times as many updates", window=60),
    _gradient("window-45min", "gradients through 45 minutes; a third of the updates", window=540),
    _gradient("few-crystals", "48 crystals at once, not 192; four times as many updates", num_envs=48),
    _gradient("long-adam", "Adam remembers a thousand squared gradients, its default, not ten", beta2=0.999),
    _gradient("own-cost", "the environment's own weights of the cost", weights=OWN_WEIGHTS),
    _gradient("smooth", "an action that returns to nominal by itself", action="smooth"),
    Variant(SPECIALIST, "going on from gradient on its own scenario; weights of whitened features"),
    _specialist("plain", "weights of the features as they are", whitened=False),
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
)
"""Every row, in the table's order; its agents are called by its name."""
