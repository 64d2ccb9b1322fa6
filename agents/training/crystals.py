"""Crystals of several scenarios side by side, as one differentiable batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.differentiable import DifferentiableBatch, Step


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
