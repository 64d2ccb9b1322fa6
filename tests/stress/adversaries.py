"""Actions that look for trouble: extremes, bang-bang, long saturation, infinities; feedback that saves a crystal while
its heater saturates."""

import numpy as np

from tests.equations import hold

KINDS = (
    "uniform", "bang-bang", "full pull", "no pull", "kept alive, hot", "kept alive, cold", "infinite", "chatter",
    "random walk", "kept alive, bang-bang heat",
)  # fmt: skip
"""One kind a slot, in turn."""
EXTREME = np.array([np.inf, -np.inf, 1e308, -1e308, 1e-320, -0.0, 1.0 + 1e-7, -1.0 - 1e-7])


class Adversaries:
    """Actions for ``num_envs`` slots, slot i by kind i modulo the number of kinds."""

    def __init__(self, num_envs, seed):
        self._kind = np.arange(num_envs) % len(KINDS)
        self._random = np.random.default_rng([20, seed])
        self._bang = np.ones((num_envs, 2))
        self._walk = np.zeros((num_envs, 2))
        self._turn = 0

    def actions(self, infos, height):
        """The next actions, shape (num_envs, 2), from the last infos and the nominal heights [m], shape (num_envs,)."""
        random, n = self._random, len(self._kind)
        self._turn += 1
        self._bang *= np.where(random.random((n, 2)) < 0.02, -1.0, 1.0)
        self._walk = np.clip(self._walk + 0.1 * random.standard_normal((n, 2)), -1.5, 1.5)
        alive = hold(infos, height) + 0.02 * random.standard_normal(n)
        extreme = EXTREME[random.integers(len(EXTREME), size=(n, 2))]
        chatter = np.full((n, 2), 1.0 if self._turn % 2 else -1.0)
        one, none = np.ones(n), np.zeros(n)
        pairs = [(one, none), (-one, none), (alive, one), (alive, -one), (alive, self._bang[:, 1])]
        full, no, hot, cold, bang_heat = (np.stack(pair, axis=-1) for pair in pairs)
        uniform = random.uniform(-1.0, 1.0, (n, 2))
        by_kind = [uniform, self._bang, full, no, hot, cold, extreme, chatter, self._walk, bang_heat]
        return np.stack(by_kind)[self._kind, np.arange(n)]
