"""The policy network: an actor with a linear path beside its layers, and a critic that may see more than it.

Actor: observation -> normalise -> tanh layers beside the normalised observation itself -> linear -> action. The linear
path carries what a linear controller would do, the layers what bends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

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


def visible_channels(channels: int, memory: float) -> npt.NDArray[np.float32]:
    """1 for what networks see, 0 for past samples older than ``memory`` [s], shape (channels,)."""
    visible = np.ones(channels, np.float32)
    if channels >= len(HISTORY):
        lagged = visible[len(HISTORY) - len(LAGS) * len(LAGGED) : len(HISTORY)]
        lagged[:] = np.repeat(np.array(LAGS) <= memory, len(LAGGED))
    return visible


def tanh_layers(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with tanh after each."""
    layers: list[nn.Module] = []
    for wide, narrow in pairwise(sizes):
        layers += [nn.Linear(wide, narrow), nn.Tanh()]
    return nn.Sequential(*layers)


class Normalise(BaseFeaturesExtractor):
    """Normalised observation; part of the saved policy."""

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
        """Set what observations are normalised with: (observation - mean) @ scaling, shapes (channels,) and square.

        Channels that are not visible count as their mean.
        """
        self.mean.copy_(torch.as_tensor(mean))
        self.scaling.copy_(torch.as_tensor(scaling))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, channels)."""
        centred = (observations - self.mean) * self.visible
        return torch.clamp(centred @ self.scaling, -NORMALISED_LIMIT, NORMALISED_LIMIT)


class Beside(nn.Module):
    """What layers make of their input, and beside it the input itself."""

    def __init__(self, layers: nn.Module) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Shape (n, k) to (n, hidden + k)."""
        return torch.cat([self.layers(x), x], dim=1)


class ActorCritic(nn.Module):
    """The layers of both: the actor sees the first ``measured`` channels, the critic all."""

    pairs: torch.Tensor

    def __init__(self, channels: int, measured: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.measured, truths = measured, channels - measured
        self.register_buffer("pairs", torch.triu_indices(truths, truths), persistent=False)
        import os

        skip = os.environ.get("SKIP", "1") == "1"
        self.latent_dim_pi = (measured, *hidden)[-1] + (measured if skip else 0)
        self.latent_dim_vf = (channels, *hidden)[-1] + truths + self.pairs.shape[1]
        self.policy_net = (Beside if skip else (lambda x: x))(tanh_layers([measured, *hidden]))
        self.value_net = tanh_layers([channels, *hidden])

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latents of actor and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, hidden + measured)."""
        latent: torch.Tensor = self.policy_net(features[:, : self.measured])
        return latent

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, hidden + true channels and their products).

        The cost to go of a nearly linear plant is nearly quadratic in its state.
        """
        truths = features[:, self.measured :]
        products = truths[:, self.pairs[0]] * truths[:, self.pairs[1]]
        return torch.cat([self.value_net(features), truths, products], dim=1)


class AsymmetricPolicy(ActorCriticPolicy):
    """PPO's policy of :class:`Normalise` and :class:`ActorCritic`."""

    features_extractor: Normalise
    action_net: nn.Linear
    mlp_extractor: ActorCritic  # type: ignore[assignment]  # has all of MlpExtractor that ActorCriticPolicy uses

    def __init__(
        self,
        observation_space: Box,
        action_space: Box,
        lr_schedule: Any,
        *,
        hidden: tuple[int, ...] = (64, 64),
        memory: float = LAGS[-1],
        **options: Any,
    ) -> None:
        self.hidden = hidden
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=Normalise,
            features_extractor_kwargs={"memory": memory},
            **options,
        )

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = ActorCritic(self.features_dim, min(self.features_dim, len(HISTORY)), self.hidden)
