"""Crystals of several scenarios side by side, as one differentiable batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.differentiable import DifferentiableBatch, Step

MOST_SHARE, ENOUGH = 0.1, 8
"""What is usual moves by this share towards the mean of so many crystals or more; by less towards that of fewer."""
LEAST_COST = 1e-9
"""Least usual cost that a cost is divided by [-]."""
RELATIVE = 0.05, 20.0
"""Range that a crystal's cost relative to the usual one is held within [-]."""


class Crystals:
    """So many slots of each configuration, numbered through; the configurations differ in their scenario alone."""

    def __init__(self, parts: Sequence[tuple[Config, int]]) -> None:
        self.batches = [DifferentiableBatch(config, slots) for config, slots in parts if slots]
        self.ends = np.cumsum([batch.num_envs for batch in self.batches])
        self.num_envs = int(self.ends[-1])
        self.measured_by_state = self.batches[0].measured_by_state

    def reset(self, seeds: Sequence[int], which: Sequence[int] | None = None) -> npt.NDArray[np.float32]:
        """Draw the episodes of these seeds for the slots ``which``, by default all. Returns "measured"."""
        slots, given = np.arange(self.num_envs) if which is None else np.asarray(which), np.asarray(seeds)
        of, found = np.searchsorted(self.ends, slots, side="right"), []
        for place, batch in enumerate(self.batches):
            mine = of == place
            first = self.ends[place] - batch.num_envs
            found.append(batch.reset(given[mine].tolist(), (slots[mine] - first).tolist())[1])
        return np.concatenate(found)

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


class Evenness:
    """What a crystal's gradient is multiplied by, so that it counts by the root of its cost and not by its cost.

    Its cost so far is taken relative to what is usual of its scenario at its age, because every crystal starts with a
    radius error.
    """

    def __init__(self, batch: Crystals, windows: int) -> None:
        self._windows = windows
        self._scenario = np.searchsorted(batch.ends, np.arange(batch.num_envs), side="right")
        self._usual = np.zeros(len(batch.ends) * windows)
        self._age = np.zeros(batch.num_envs, np.int64)
        self._relative = np.ones(batch.num_envs)

    def weights(self, cost: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Of each crystal, from the mean cost of its present window; both of shape (n,)."""
        at = self._scenario * self._windows + self._age
        many = np.bincount(at, minlength=self._usual.size)
        mean = np.bincount(at, cost, self._usual.size) / np.maximum(many, 1)
        share = np.where(self._usual == 0.0, 1.0, MOST_SHARE * np.minimum(1.0, many / ENOUGH)) * (many > 0)
        self._usual += share * (mean - self._usual)
        self._age += 1
        self._relative += (cost / np.maximum(self._usual[at], LEAST_COST) - self._relative) / (self._age + 1)
        held: npt.NDArray[np.float64] = np.clip(self._relative, *RELATIVE)
        return 1.0 / np.sqrt(held)

    def begin(self, slots: Sequence[int]) -> None:
        """New crystals grow in these slots."""
        self._age[slots], self._relative[slots] = 0, 1.0
