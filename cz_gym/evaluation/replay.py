"""Counterfactuals: the same episodes, bit for bit, with another controller from some moment on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.errors import CzError

from .rollout import Rollout, call_policy, check_policy, check_seeds, informed, rollout


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
    policy, instead = (informed(one, config, seeds) for one in (policy, instead))
    takeover = round(at / config.control_interval)
    actual = rollout(_Handover(policy, instead, config.steps, False), config, seeds)
    other = rollout(_Handover(policy, instead, takeover, watches), config, seeds)
    return Counterfactual(takeover * config.control_interval, actual, other)


@dataclass(frozen=True)
class _Handover:
    """One policy until a step, then another one, which may have watched before; memory: step, and that of each."""

    first: Any
    second: Any
    step: int
    watches: bool

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        k, first, second = state or (0, None, None)
        if k >= self.step:
            begins = episode_start if self.watches or k > self.step else np.ones(len(observation), np.bool_)
            action, second = call_policy(self.second, observation, second, begins)
            return action, (k + 1, first, second)
        if self.watches:
            _, second = call_policy(self.second, observation.copy(), second, episode_start)
        action, first = call_policy(self.first, observation, first, episode_start)
        return action, (k + 1, first, second)
