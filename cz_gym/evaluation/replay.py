"""Counterfactuals: the same episodes with another controller from some moment on.

The environment's state is saved and continued bit for bit, so that the controller is all that differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.errors import CzError

from .rollout import EpisodeBatch, Rollout, call_policy, check_policy, check_seeds


@dataclass(frozen=True)
class Counterfactual:
    """Episodes under one controller, and the same episodes under another one from some moment on."""

    at: float
    """Moment at which the other controller takes over [s]."""
    actual: Rollout
    instead: Rollout
    """Rollout with the other controller; equal to ``actual`` up to ``at``."""


class Playback:
    """Policy that plays logged actions back without reading observations; it holds the last one at the end."""

    def __init__(self, actions: npt.ArrayLike) -> None:
        """``actions`` has shape (steps, 2), for every episode alike, or (steps, episodes, 2); CzError otherwise."""
        self.actions = np.array(actions, np.float32)
        if self.actions.ndim not in (2, 3) or self.actions.shape[-1] != 2 or len(self.actions) == 0:
            raise CzError(
                f"logged actions must be of shape (steps, 2) or (steps, episodes, 2), not {self.actions.shape}"
            )

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Return the next logged action of each episode; ``state`` is the number of actions played."""
        k = 0 if state is None else state
        action = self.actions[min(k, len(self.actions) - 1)]
        return np.broadcast_to(action, (len(observation), 2)).copy(), k + 1


def replay(
    policy: Any,
    instead: Any,
    config: Config,
    seeds: Sequence[int] | npt.NDArray[Any],
    at: float = 0.0,
    watches: bool = False,
) -> Counterfactual:
    """Run ``policy`` on one episode a seed, and again with ``instead`` from ``at`` [s] on.

    ``policy`` may be a :class:`Playback` of logged actions. ``instead`` begins with an empty memory at ``at``, as in a
    new episode, unless it ``watches``: then it has seen every observation before, and its actions were not taken.
    ``at`` is rounded to the control interval. Raises CzError without a seed, for a moment outside the horizon, and for
    policies that were made for another environment.
    """
    for one in (policy, instead):
        check_policy(one, config)
    seeds = check_seeds(seeds)
    if not 0.0 <= at <= config.horizon:
        raise CzError(f"at must lie in the episode, 0 to {config.horizon:g} s, not {at!r}")
    policy, instead = (
        one.for_episodes(config, list(seeds)) if hasattr(one, "for_episodes") else one for one in (policy, instead)
    )
    takeover = round(at / config.control_interval)
    actual, watcher = EpisodeBatch(config, seeds), _Watched(policy, instead if watches else None)
    actual.run(watcher, takeover)
    other = actual.fork()
    other.memory = watcher.memory
    other.begins = np.zeros_like(actual.begins) if watches and takeover > 0 else np.ones_like(actual.begins)
    actual.run(policy, config.steps)
    other.run(instead, config.steps)
    return Counterfactual(takeover * config.control_interval, actual.finish(), other.finish())


class _Watched:
    """A policy that acts while another one gets the same observations."""

    def __init__(self, policy: Any, watcher: Any) -> None:
        self.policy, self.watcher, self.memory = policy, watcher, None

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        if self.watcher is not None:
            _, self.memory = call_policy(self.watcher, observation.copy(), self.memory, episode_start)
        return call_policy(self.policy, observation, state, episode_start)
