"""Crystals of several scenarios side by side, as one differentiable batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.differentiable import DifferentiableBatch, Step


class Mixture:
    """Slots of several scenarios with one numbering: ``shares`` of them by the scenarios' names, None for one."""

    def __init__(self, config: Config, n: int, shares: Mapping[str, float] | None) -> None:
        names = shares or {config.scenario.name: 1.0}
        sizes = np.diff(np.rint(n * np.cumsum([0.0, *names.values()])).astype(int))
        configs = [config.with_scenario(name) if shares else config for name in names]
        self.batches = [DifferentiableBatch(each, int(k)) for each, k in zip(configs, sizes, strict=True) if k]
        self.ends = np.cumsum([batch.num_envs for batch in self.batches])
        self.measured_by_state = self.batches[0].measured_by_state

    def reset(self, seeds: Sequence[int], which: Sequence[int]) -> tuple[Any, ...]:
        """Draw the episodes of these seeds for these slots: state and "measured" of all."""
        slots, given = np.asarray(which), np.asarray(seeds)
        part, seen = np.searchsorted(self.ends, slots, side="right"), []
        for place, batch in enumerate(self.batches):
            mine = part == place
            first = self.ends[place] - batch.num_envs
            seen.append(batch.reset(given[mine].tolist(), (slots[mine] - first).tolist()))
        return tuple(np.concatenate(each) for each in zip(*seen, strict=True))

    def step(self, actions: npt.NDArray[Any]) -> Step:
        """One control interval of all (:meth:`cz_gym.differentiable.DifferentiableBatch.step`)."""
        parts = np.split(actions, self.ends[:-1])
        steps = [batch.step(part) for batch, part in zip(self.batches, parts, strict=True)]
        return Step(*(np.concatenate(each) for each in zip(*steps, strict=True)))

    @property
    def grows(self) -> npt.NDArray[np.bool_]:
        """Which crystals grew in the last step, shape (n,)."""
        return np.concatenate([batch.grows for batch in self.batches])

    def close(self) -> None:
        """Stop the threads."""
        for batch in self.batches:
            batch.close()
