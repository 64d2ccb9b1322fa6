"""A callback of stable-baselines3 that keeps the statistics which observations are normalised with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.callbacks import BaseCallback

from .networks import Normalise

STD_FLOOR = 0.02
"""Least standard deviation that an observation is divided by."""
RECENT = 400
"""Window of an off-policy learner's statistics [steps of all slots], refreshed every half window."""


class Statistics(BaseCallback):
    """Sets the network's normalisation from the observations: freely at first, then slowly, after ``until`` no more.

    Works for on-policy learners at the end of each rollout, for off-policy ones from when learning starts. ``known``:
    a resumed learner has statistics already.
    """

    def __init__(self, until: int, known: bool = False) -> None:
        super().__init__()
        self.until = until
        self.rounds = 10 if known else 0

    def _on_training_start(self) -> None:
        if not any(bool(module.mean.any()) for module in self._normalisations()):
            self.rounds = 0  # a resumed run may have ended before its first statistics

    def _normalisations(self) -> list[Normalise]:
        return [module for module in self.model.policy.modules() if isinstance(module, Normalise)]

    def _on_step(self) -> bool:
        model: Any = self.model
        if hasattr(model, "replay_buffer"):
            steps = (self.num_timesteps - model.learning_starts) // model.n_envs + 1
            due = steps % (RECENT // 2) == 0 and self.num_timesteps <= self.until
            buffer = model.replay_buffer
            if steps >= 0 and (due or self.rounds == 0) and buffer.pos:
                self._update(buffer.observations[max(buffer.pos - RECENT, 0) : buffer.pos])
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        if hasattr(model, "rollout_buffer") and (self.num_timesteps <= self.until or self.rounds == 0):
            self._update(model.rollout_buffer.observations)

    def _update(self, observations: npt.NDArray[np.float32]) -> None:
        seen = observations.reshape(-1, observations.shape[-1])
        self.rounds += 1
        share = max(1.0 / self.rounds, 0.1)
        for module in self._normalisations():
            mean, var = module.mean.numpy(), module.std.numpy() ** 2
            mean = mean + share * (seen.mean(axis=0) - mean)
            var = var + share * (seen.var(axis=0) - var)
            module.set(mean, np.maximum(np.sqrt(var), STD_FLOOR))
