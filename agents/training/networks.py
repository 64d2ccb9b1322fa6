"""Networks: normalised observations, a critic that may see more than its actor, a skip connection."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from cz_gym.observation import HISTORY, LAGGED, LAGS

NORMALISED_LIMIT = 30.0
"""Largest normalised channel [-]."""
VARIANCE_FLOOR = 1e-6
"""Least variance that whitening divides by [-]."""


def visible_channels(channels: int, memory: float) -> npt.NDArray[np.float32]:
    """1 for channels that networks see, 0 for past samples older than ``memory`` [s], shape (channels,)."""
    visible = np.ones(channels, np.float32)
    if channels >= len(HISTORY):
        lagged = visible[len(HISTORY) - len(LAGS) * len(LAGGED) : len(HISTORY)]
        lagged[:] = np.repeat(np.array(LAGS) <= memory, len(LAGGED))
    return visible


def whitening(covariance: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """The symmetric matrix that makes channels of this covariance uncorrelated, with variance one."""
    variances, axes = np.linalg.eigh(covariance)
    scaling: npt.NDArray[np.float64] = axes / np.sqrt(np.maximum(variances, VARIANCE_FLOOR)) @ axes.T
    return scaling


def tanh_layers(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with tanh after each."""
    layers: list[nn.Module] = []
    for wide, narrow in pairwise(sizes):
        layers += [nn.Linear(wide, narrow), nn.Tanh()]
    return nn.Sequential(*layers)


class Normalise(BaseFeaturesExtractor):
    """Normalises observations; part of the saved policy."""

    visible: torch.Tensor
    mean: torch.Tensor
    scaling: torch.Tensor

    def __init__(self, observation_space: Box, memory: float = LAGS[-1]) -> None:
        (channels,) = observation_space.shape
        super().__init__(observation_space, channels)
        self.register_buffer("visible", torch.as_tensor(visible_channels(channels, memory)), persistent=False)
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("scaling", torch.eye(channels))

    def set(self, mean: npt.NDArray[Any], scaling: npt.NDArray[Any]) -> None:
        """Set mean and scaling of (observation - mean) @ scaling, shapes (channels,) and square.

        Channels that are not visible count as their mean.
        """
        self.mean.copy_(torch.as_tensor(mean))
        self.scaling.copy_(torch.as_tensor(scaling))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, channels)."""
        centred = (observations - self.mean) * self.visible
        return torch.clamp(centred @ self.scaling, -NORMALISED_LIMIT, NORMALISED_LIMIT)


class SkipConcat(nn.Module):
    """The output of layers, concatenated with their input."""

    def __init__(self, layers: nn.Module) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Shape (n, k) to (n, hidden + k)."""
        return torch.cat([self.layers(x), x], dim=1)


class ActorCritic(nn.Module):
    """Layers of actor and critic: the actor sees the first ``measured`` channels, the critic all."""

    def __init__(self, channels: int, measured: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.measured = measured
        self.policy_net, self.value_net = tanh_layers([measured, *hidden]), tanh_layers([channels, *hidden])
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


class Actor(NamedTuple):
    """A deterministic actor, ready to export."""

    extractor: nn.Module
    """First module of the actor: its features extractor."""
    lstm: nn.LSTM | None
    """Its LSTM; None without one."""
    layers: Sequence[nn.Module]

    @property
    def remembers(self) -> int:
        """Length of its state: hidden and cell values of its LSTM."""
        return 2 * self.lstm.hidden_size if self.lstm is not None else 0
