"""Observations for tests of controllers: of given values, and of a batch that is driven at random."""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from cz_gym import CzVectorEnv
from cz_gym.process import PULL_SCALE, scales
from cz_gym.spaces import MEASURED

PLAIN: dict[str, Any] = {"observation": "measured", "action": "direct"}
"""Settings of an environment for classical controllers."""


def measured(**values: Any) -> np.ndarray:
    """A "measured" observation of these values [SI], of shape (n,) or numbers; the rest zero, the camera valid."""
    given = {name: np.atleast_1d(value) for name, value in {"valid": 1.0, **values}.items()}
    zero = np.zeros(max(len(value) for value in given.values()))
    columns = [given.get(channel.name, 0.0) + zero for channel in MEASURED]
    return np.stack(columns, axis=1) / scales(MEASURED, PULL_SCALE)


class Watched:
    """A policy whose memory is kept, sample by sample: of all samples, or of that many."""

    def __init__(self, policy: Any, last: int | None = None) -> None:
        self.policy, self.states = policy, deque(maxlen=last)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, state = self.policy.predict(observation, state, episode_start)
        self.states.append(state)
        return action, state


def actions_of(policy: Any, rows: Iterable[Any]) -> np.ndarray:
    """Actions of one slot, for its observations sample by sample."""
    state, found = None, []
    for row in rows:
        action, state = policy.predict(row, state)
        found.append(action[0])
    return np.array(found)


def pulls(policy: Any, rows: Iterable[Any]) -> np.ndarray:
    """The same as pull speeds above nominal [m/s]."""
    return actions_of(policy, rows)[:, 0].astype(float) * PULL_SCALE


def observations(n: int = 3, steps: int = 20, **keywords: Any) -> Iterator[Any]:
    """Observations of n slots, sample by sample."""
    env = CzVectorEnv(n, **keywords)
    observation, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        yield observation
        observation = env.step(rng.uniform(-0.1, 0.1, (n, 2)))[0]
