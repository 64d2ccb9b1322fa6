"""Callbacks and action noise of training recipes, for stable-baselines3: what makes the noise of learning smaller."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from torch.utils.hooks import RemovableHandle


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
    """Lets exploration fall linearly with the steps, from ``start`` by ``fall``.

    It is measured by the logarithm of the standard deviation of PPO's actions, and by SAC's ``target_entropy``.
    """

    def __init__(self, start: float, fall: float) -> None:
        super().__init__()
        self.start, self.end = start, start - fall

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        value: float = self.end + (self.start - self.end) * model._current_progress_remaining
        if isinstance(model, SAC):
            model.target_entropy = value
        else:
            model.policy.log_std.data.fill_(value)


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


class ClipErrors(BaseCallback):
    """Clips the errors of SAC's critics at a quantile of their size in the batch, as Huber's loss does.

    A few large ones, which the action hardly decides, would else make most of the loss.
    """

    hook: RemovableHandle

    def __init__(self, quantile: float) -> None:
        super().__init__()
        self.quantile = quantile

    def _on_training_start(self) -> None:
        model: Any = self.model
        self.hook = model.critic.register_forward_hook(self._watch)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.hook.remove()

    def _watch(self, critic: Any, inputs: tuple[torch.Tensor, ...], values: tuple[Any, ...]) -> None:
        _, actions = inputs
        if torch.is_grad_enabled() and not actions.requires_grad:  # the critics' loss; the actor's follows its actions
            for each in values:
                each.register_hook(self._clipped)

    def _clipped(self, errors: torch.Tensor) -> torch.Tensor:
        most = errors.abs().quantile(self.quantile)
        return errors.clamp(-most, most)


class NormalNoise(VectorizedActionNoise):
    """Normal noise of ``num_envs`` actions of ``size`` entries; stable-baselines3's own draws action by action."""

    def __init__(self, std: float, num_envs: int, size: int) -> None:
        super().__init__(NormalActionNoise(np.zeros(size), np.full(size, std)), num_envs)
        self.std, self.shape = std, (num_envs, size)

    def __call__(self) -> np.ndarray:
        """Draw the noise of all actions at once, shape (num_envs, size), in shares of the actions' range."""
        return np.random.normal(0.0, self.std, self.shape).astype(np.float32)  # seeded by set_random_seed
