"""The policy network: an actor that moves the drives from where they are, a critic that may see more.

Actor: observation -> normalise -> (tanh layers -> linear) + linear -> two outputs;
action = skip * (applied v_p, Q_H) + scale * output. The linear path carries what a linear controller would do, the
layers what bends it. The applied drives stand in the observation, so that the actor is one function of it and exports
as one file.
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

from cz_gym.observation import DRIVE_CHANNELS, HISTORY, LAGGED, LAGS

NORMALISED_LIMIT = 30.0
"""Largest normalised channel [-]."""
DRIVES = len(DRIVE_CHANNELS)


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
    """Normalised observation, on request with the two applied drives appended raw; part of the saved policy."""

    visible: torch.Tensor
    mean: torch.Tensor
    scaling: torch.Tensor

    def __init__(self, observation_space: Box, drives: bool = True, memory: float = LAGS[-1]) -> None:
        (channels,) = observation_space.shape
        super().__init__(observation_space, channels + (DRIVES if drives else 0))
        self.drives = drives
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
        """Shape (n, channels) to (n, channels) or (n, channels + 2)."""
        centred = (observations - self.mean) * self.visible
        normalised = torch.clamp(centred @ self.scaling, -NORMALISED_LIMIT, NORMALISED_LIMIT)
        if not self.drives:
            return normalised
        return torch.cat([normalised, observations[:, list(DRIVE_CHANNELS)]], dim=1)


class ActorCritic(nn.Module):
    """Hidden layers: the actor sees the first ``measured`` channels, the critic all; drives pass by the actor."""

    pairs: torch.Tensor

    def __init__(self, channels: int, measured: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.channels, self.measured = channels, measured
        truths = channels - measured
        self.register_buffer("pairs", torch.triu_indices(truths, truths), persistent=False)
        self.latent_dim_pi = (measured, *hidden)[-1]
        self.latent_dim_vf = (channels, *hidden)[-1] + truths + self.pairs.shape[1]
        self.actor = tanh_layers([measured, *hidden])
        self.direct = nn.Linear(measured, DRIVES)
        self.critic = tanh_layers([channels, *hidden])

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latents of actor (with its linear path and drives) and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, features) to (n, hidden + 4)."""
        seen = features[:, : self.measured]
        return torch.cat([self.actor(seen), self.direct(seen), features[:, self.channels :]], dim=1)

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, features) to (n, hidden + true channels and their products).

        The cost to go of a nearly linear plant is nearly quadratic in its state.
        """
        truths = features[:, self.measured : self.channels]
        products = truths[:, self.pairs[0]] * truths[:, self.pairs[1]]
        return torch.cat([self.critic(features[:, : self.channels]), truths, products], dim=1)


class DriveHead(nn.Module):
    """action = skip * drives + scale * (linear(latent) + direct)."""

    scale: torch.Tensor

    def __init__(self, linear: nn.Linear, skip: float, scale: tuple[float, float]) -> None:
        super().__init__()
        self.linear, self.skip = linear, skip
        self.register_buffer("scale", torch.tensor(scale))

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Shape (n, hidden + 4) to (n, 2)."""
        hidden, direct, drives = torch.tensor_split(latent, (-2 * DRIVES, -DRIVES), dim=1)
        mean: torch.Tensor = self.skip * drives + self.scale * (self.linear(hidden) + direct)
        return mean


class DrivePolicy(ActorCriticPolicy):
    """PPO's policy of :class:`Normalise`, :class:`ActorCritic` and :class:`DriveHead`."""

    features_extractor: Normalise
    mlp_extractor: ActorCritic  # type: ignore[assignment]  # has all of MlpExtractor that ActorCriticPolicy uses
    action_net: DriveHead

    def __init__(
        self,
        observation_space: Box,
        action_space: Box,
        lr_schedule: Any,
        *,
        hidden: tuple[int, ...] = (128, 128),
        skip: float = 1.0,
        scale: tuple[float, float] = (0.05, 0.05),
        noise: tuple[float, float] = (0.05, 0.05),
        memory: float = LAGS[-1],
        **options: Any,
    ) -> None:
        self.hidden, self.skip, self.scale, self.noise = hidden, skip, scale, noise
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=Normalise,
            features_extractor_kwargs={"memory": memory},
            **options,
        )

    def _build_mlp_extractor(self) -> None:
        channels = self.features_dim - DRIVES
        self.mlp_extractor = ActorCritic(channels, min(channels, len(HISTORY)), self.hidden)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        linear: Any = self.action_net
        self.action_net = DriveHead(linear, self.skip, self.scale)
        with torch.no_grad():
            self.log_std.copy_(torch.log(torch.tensor(self.noise)))
