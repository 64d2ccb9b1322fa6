"""Policies whose episodes are recorded, by name, and the scores that learners from their episodes are compared with."""

import pkgutil
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from cz_gym.config import Config, check_config
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.machine.identify.excitation import Excited
from cz_gym.support.names import unknown

CONTROLLERS, AGENTS = "cz_gym.baselines.registry:CONTROLLERS", "cz_gym.agents:load"
"""Names of the objects that provide policies; imported only when needed, because this package knows no policy."""
OWN = "random", "operator", "mixed"
"""Names of policies that only data sets have."""
MIXED = "paper", "lqg", "pid-uncompensated", "random"
"""Policies that take turns in the set "mixed"; the last two lose crystals."""
RANDOM_STREAM = 2
"""Random stream of random actions, separate from those of the crystal and its excitation with the same seed."""


class Random:
    """A policy of uniform random "smooth" actions; each crystal's seed gives its own."""

    settings = MappingProxyType({"action": "smooth"})

    def __init__(self, seeds: Sequence[int] = ()) -> None:
        self.streams = [np.random.default_rng([seed, RANDOM_STREAM]) for seed in seeds]

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> "Random":
        """The policy for one episode a seed."""
        return Random(seeds)

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Any, Any]:
        """Return actions, shape (episodes, 2)."""
        return np.array([stream.uniform(-1.0, 1.0, 2) for stream in self.streams], np.float32), state


def find_policy(name: str, config: Config) -> Any:
    """The policy of that name, made for a config; a tuple of several for "mixed". CzError lists the known names.

    It is a controller, a shipped agent, an agent's file, "random" or "operator", a PID with small moves of the drives
    on top, as an operator's log for identification has them.
    """
    controllers = {entry.name: entry for entry in pkgutil.resolve_name(CONTROLLERS) if not entry.privileged}
    check_config(config)
    if name in controllers:
        return controllers[name].make(config)
    if name == "random":
        return Random()
    if name == "operator":
        return Excited(find_policy("paper", config))
    if name == "mixed":
        return tuple(find_policy(each, config) for each in MIXED)
    load = pkgutil.resolve_name(AGENTS)
    try:
        settings = settings_of(load(name))
    except ValueError as error:
        raise CzError(unknown("policy", name, [*controllers, *OWN], f"; or an agent: {error}")) from None
    return load(name, replace(config, **settings))


@lru_cache(maxsize=8)
def reference_scores(config: Config) -> dict[str, float]:
    """Minari's ``ref_min_score`` and ``ref_max_score``: mean returns of open loop and of the best classical controller.

    The crystals are the first 100 of validation; the controllers are those of README's table.
    """
    table = pkgutil.resolve_name(CONTROLLERS)
    chosen = [each for each in table if each.name == "open-loop" or (each.quoted and not each.bound)]
    runs = [rollout(each.make(config), config, VALIDATION_SEEDS[:100]) for each in chosen]
    means = [float(run.reward.sum(axis=0).mean()) for run in runs]
    return {"ref_min_score": means[0], "ref_max_score": max(means)}


def settings_of(policy: Any) -> dict[str, Any]:
    """The environment settings "observation" and "action" of a policy; by default "measured" and "direct"."""
    settings = {"observation": "measured", "action": "direct"} | getattr(policy, "settings", {})
    return {name: settings[name] for name in ("observation", "action")}


def own_noise(policy: Any, noise: float) -> float:
    """The highest level of the excitation [-] of a policy: 0 for one that moves the drives by itself."""
    return 0.0 if isinstance(policy, Random | Excited) else noise
