"""Networks for learning from reward: normalised observations, and a critic that sees more than its actor."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from torch import nn

from cz_gym.observation import HISTORY

NORMALISED_LIMIT = 30.0
"""Largest normalised channel [-]."""


class Normalise(BaseFeaturesExtractor):
    """Normalises observations by their mean and standard deviation; part of the saved policy."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, observation_space: Box) -> None:
        (channels,) = observation_space.shape
        super().__init__(observation_space, channels)
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))

    def set(self, mean: npt.NDArray[Any], std: npt.NDArray[Any]) -> None:
        """Set mean and standard deviation, shape (channels,) each."""
        self.mean.copy_(torch.as_tensor(mean))
        self.std.copy_(torch.as_tensor(std))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, channels)."""
        return torch.clamp((observations - self.mean) / self.std, -NORMALISED_LIMIT, NORMALISED_LIMIT)


class ActorCritic(nn.Module):
    """Layers of actor and critic: the actor sees the first ``measured`` channels, the critic all."""

    def __init__(self, channels: int, measured: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.measured = measured
        self.policy_net, self.value_net = (
            nn.Sequential(*create_mlp(width, -1, list(hidden), nn.Tanh)) for width in (measured, channels)
        )
        self.latent_dim_pi, self.latent_dim_vf = (measured, *hidden)[-1], (channels, *hidden)[-1]

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Last hidden layers of actor and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, hidden)."""
        latent: torch.Tensor = self.policy_net(features[:, : self.measured])
        return latent

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, hidden)."""
        latent: torch.Tensor = self.value_net(features)
        return latent


class AsymmetricPolicy(ActorCriticPolicy):
    """PPO's policy, whose actor sees the measured channels alone and whose critic also sees the true state."""

    mlp_extractor: ActorCritic  # type: ignore[assignment]  # has all of MlpExtractor that ActorCriticPolicy uses

    def __init__(self, *arguments: Any, hidden: tuple[int, ...] = (64, 64), **options: Any) -> None:
        self.hidden = hidden
        super().__init__(*arguments, **options)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = ActorCritic(self.features_dim, min(self.features_dim, len(HISTORY)), self.hidden)
