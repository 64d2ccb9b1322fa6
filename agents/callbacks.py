"""Callbacks of training recipes, for stable-baselines3's ``learn``: what makes the noise of learning smaller."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback


class AverageWeights(BaseCallback):
    """Keeps an exponential mean of a policy's weights over its last updates (Polyak and Juditsky 1992).

    While the learning rate is high, the weights move around the place that they tend to; their mean is nearer to it.
    It changes nothing in training. ``updates`` is the number of updates that the mean spans.
    """

    def __init__(self, updates: float) -> None:
        super().__init__()
        self.updates, self.seen, self.means = updates, 0, list[torch.Tensor]()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:  # after each update; before the first it takes the weights as they are
        weights = list(self.model.policy.parameters())
        self.means = self.means or [each.detach().clone() for each in weights]
        self.seen += 1
        share = max(1.0 / self.seen, 1.0 / max(self.updates, 1.0))
        for mean, weight in zip(self.means, weights, strict=True):
            mean.lerp_(weight.detach(), share)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Let the policy act by the mean within a ``with`` block."""
        weights = list(self.model.policy.parameters())
        own = [each.detach().clone() for each in weights]
        try:
            _copy(self.means or own, weights)  # no mean before the first rollout
            yield
        finally:
            _copy(own, weights)


def _copy(values: list[torch.Tensor], weights: list[torch.nn.Parameter]) -> None:
    with torch.no_grad():
        for value, weight in zip(values, weights, strict=True):
            weight.copy_(value)


class FadeExploration(BaseCallback):
    """Lets the logarithm of PPO's standard deviation fall linearly with the steps, from ``start`` by ``fall``."""

    def __init__(self, start: float, fall: float) -> None:
        super().__init__()
        self.start, self.end = start, start - fall

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        left: float = model._current_progress_remaining
        model.policy.log_std.data.fill_(self.end + (self.start - self.end) * left)


class ClipAdvantages(BaseCallback):
    """Clips PPO's advantages, less their mean, at a quantile of their size; the critic's targets stay.

    A few of them, from crystals that go wrong, would else make most of the gradient, and much else than the action
    decides how large they are.
    """

    def __init__(self, quantile: float) -> None:
        super().__init__()
        self.quantile = quantile

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        advantages = model.rollout_buffer.advantages
        advantages -= advantages.mean()
        most = np.quantile(np.abs(advantages), self.quantile)
        np.clip(advantages, -most, most, out=advantages)
