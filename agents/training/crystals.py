"""Crystals of several scenarios side by side, as one differentiable batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.differentiable import DifferentiableBatch, Step

MOST_SHARE, ENOUGH = 0.1, 8
"""Smoothing factor of the running mean cost; smaller below ENOUGH crystals."""
LEAST_COST = 1e-9
"""Least running mean cost that a cost is divided by [-]."""
RELATIVE = 0.05, 20.0
"""Range that a crystal's cost, relative to the running mean, is clipped to."""


class Crystals:
    """Slots of several configurations, which differ in their scenario alone, with one numbering."""

    def __init__(self, parts: Sequence[tuple[Config, int]]) -> None:
        self.batches = [DifferentiableBatch(config, slots) for config, slots in parts if slots]
        self.ends = np.cumsum([batch.num_envs for batch in self.batches])
        self.num_envs = int(self.ends[-1])
        self.measured_by_state = self.batches[0].measured_by_state

    def reset(self, seeds: Sequence[int], which: Sequence[int] | None = None) -> npt.NDArray[np.float32]:
        """Draw the episodes of these seeds for the slots ``which``, by default all. Returns "measured"."""
        slots, given = np.arange(self.num_envs) if which is None else np.asarray(which), np.asarray(seeds)
        part, seen = np.searchsorted(self.ends, slots, side="right"), []
        for place, batch in enumerate(self.batches):
            mine = part == place
            first = self.ends[place] - batch.num_envs
            seen.append(batch.reset(given[mine].tolist(), (slots[mine] - first).tolist())[1])
        return np.concatenate(seen)

    def step(self, actions: npt.NDArray[Any]) -> Step:
        """One control interval of all (:meth:`cz_gym.differentiable.DifferentiableBatch.step`)."""
        parts = np.split(actions, self.ends[:-1])
        steps = [batch.step(part) for batch, part in zip(self.batches, parts, strict=True)]
        return steps[0] if len(steps) == 1 else Step(*(np.concatenate(each) for each in zip(*steps, strict=True)))

    @property
    def grows(self) -> npt.NDArray[np.bool_]:
        """Which crystals grew in the last step, shape (n,)."""
        return np.concatenate([batch.grows for batch in self.batches])

    def close(self) -> None:
        """Stop the threads."""
        for batch in self.batches:
            batch.close()


class CostNormaliser:
    """Factors of the crystals' gradients by which each crystal counts by the root of its cost instead of its cost.

    A crystal's cost so far is relative to the running mean cost of its scenario at its age, because every crystal
    starts with a radius error.
    """

    def __init__(self, batch: Crystals, windows: int) -> None:
        self._windows = windows
        self._scenario = np.searchsorted(batch.ends, np.arange(batch.num_envs), side="right")
        self._running = np.zeros(len(batch.ends) * windows)
        self._age = np.zeros(batch.num_envs, np.int64)
        self._relative = np.ones(batch.num_envs)

    def weights(self, cost: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Each crystal's factor, from the mean cost of its present window; both of shape (n,)."""
        cell = self._scenario * self._windows + self._age
        crystals = np.bincount(cell, minlength=self._running.size)
        mean = np.bincount(cell, cost, self._running.size) / np.maximum(crystals, 1)
        smoothing = np.where(self._running == 0.0, 1.0, MOST_SHARE * np.minimum(1.0, crystals / ENOUGH))
        self._running += smoothing * (crystals > 0) * (mean - self._running)
        self._age += 1
        self._relative += (cost / np.maximum(self._running[cell], LEAST_COST) - self._relative) / (self._age + 1)
        clipped: npt.NDArray[np.float64] = np.clip(self._relative, *RELATIVE)
        return 1.0 / np.sqrt(clipped)

    def begin(self, slots: Sequence[int]) -> None:
        """Start new crystals in these slots."""
        self._age[slots], self._relative[slots] = 0, 1.0
