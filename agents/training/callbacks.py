"""Callbacks of training: observation statistics, periodic work, progress."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from .networks import Normalise

STD_FLOOR = 0.02
"""Least standard deviation an observation is divided by."""


class Statistics(BaseCallback):
    """Sets the network's normalisation from what it sees: freely at first, then slowly, then never again.

    Works for on-policy learners at the end of each rollout, for off-policy ones once, when learning starts.
    """

    def __init__(self, until: int, known: bool = False) -> None:
        super().__init__()
        self.until = until
        self.rounds = 10 if known else 0

    def _on_training_start(self) -> None:
        if not any(module.mean.any() for module in self._normalisations()):
            self.rounds = 0  # also of a run that was cut short before it knew any

    def _normalisations(self) -> list[Normalise]:
        return [module for module in self.model.policy.modules() if isinstance(module, Normalise)]

    def _on_step(self) -> bool:
        if hasattr(self.model, "replay_buffer") and self.rounds == 0:
            buffer = self.model.replay_buffer
            if self.num_timesteps >= self.model.learning_starts - self.model.n_envs:
                self._update(buffer.observations[: buffer.pos])
        return True

    def _on_rollout_end(self) -> None:
        if hasattr(self.model, "rollout_buffer") and (self.num_timesteps <= self.until or self.rounds == 0):
            self._update(self.model.rollout_buffer.observations)

    def _update(self, observations: np.ndarray) -> None:
        seen = observations.reshape(-1, observations.shape[-1])
        self.rounds += 1
        share = max(1.0 / self.rounds, 0.1)
        for module in self._normalisations():
            mean, var = module.mean.numpy(), module.scaling.diagonal().numpy() ** -2.0
            mean = mean + share * (seen.mean(axis=0) - mean)
            var = var + share * (seen.var(axis=0) - var)
            module.set(mean, np.diag(1.0 / np.maximum(np.sqrt(var), STD_FLOOR)))


class CriticFirst(BaseCallback):
    """Holds the actor still for the first steps, then lets it learn at its pace."""

    def __init__(self, steps: int, pace: float) -> None:
        super().__init__()
        self.steps, self.pace = steps, pace

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.model.policy.set_actor_pace(self.pace if self.num_timesteps > self.steps else 0.0)


class AtStart(BaseCallback):
    """Calls back before the first step."""

    def __init__(self, action: Callable[[], Any]) -> None:
        super().__init__()
        self.action = action

    def _on_training_start(self) -> None:
        self.action()

    def _on_step(self) -> bool:
        return True


class Every(BaseCallback):
    """Calls back about every so many environment steps, and every so many seconds."""

    def __init__(self, steps: int | None, seconds: float | None, action: Callable[[], Any]) -> None:
        super().__init__()
        self.steps, self.seconds, self.action = steps, seconds, action
        self.next_step = 0
        self.next_time = 0.0

    def _on_training_start(self) -> None:
        self._plan()

    def _plan(self) -> None:
        self.next_step = self.num_timesteps + (self.steps or 0)
        self.next_time = time.monotonic() + (self.seconds or 0.0)

    def _on_step(self) -> bool:
        by_step = self.steps is not None and self.num_timesteps >= self.next_step
        by_time = self.seconds is not None and time.monotonic() >= self.next_time
        if by_step or by_time:
            self.action()
            self._plan()
        return True


class Tell(BaseCallback):
    """Tells a progress bar how many steps have been taken."""

    def __init__(self, bar: Any) -> None:
        super().__init__()
        self.bar = bar

    def _on_step(self) -> bool:
        self.bar.update(self.num_timesteps - self.bar.n)
        return True
