"""Observations of a batch that is driven at random, for tests of controllers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cz_gym import CzVectorEnv


def observations(n: int = 3, steps: int = 20, **keywords: Any) -> Iterator[Any]:
    """What n slots show, sample by sample."""
    env = CzVectorEnv(n, **keywords)
    observation, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        yield observation
        observation = env.step(rng.uniform(-0.1, 0.1, (n, 2)))[0]
