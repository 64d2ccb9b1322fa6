"""The policy network: an actor that moves the drives from where they are, a critic that may see more.

Actor: observation -> normalise -> tanh layers -> two outputs; action = skip * (applied v_p, Q_H) + scale * output.
The applied drives stand in the observation, so that the whole actor is one function of it and exports as one file.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from cz_gym.observation import HISTORY, MEASURED

DRIVES = tuple([channel.name for channel in MEASURED].index(name) for name in ("v_p", "Q_H"))
"""Where an observation holds the applied drives, in action units."""
NORMALISED_LIMIT = 10.0


def tanh_layers(sizes: list[int]) -> nn.Sequential:
    """Linear layers with tanh after each."""
    layers: list[nn.Module] = []
    for wide, narrow in pairwise(sizes):
        layers += [nn.Linear(wide, narrow), nn.Tanh()]
    return nn.Sequential(*layers)


class Normalise(BaseFeaturesExtractor):
    """Normalised observation, on request with the two applied drives appended raw; part of the saved policy."""

    def __init__(self, observation_space: Box, drives: bool = True) -> None:
        channels = observation_space.shape[0]
        super().__init__(observation_space, channels + (len(DRIVES) if drives else 0))
        self.drives = drives
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))

    def set(self, mean: np.ndarray, std: np.ndarray) -> None:
        """Set what observations are normalised with, shape (channels,)."""
        self.mean.copy_(torch.as_tensor(mean))
        self.std.copy_(torch.as_tensor(std))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, channels) or (n, channels + 2)."""
        normalised = torch.clamp((observations - self.mean) / self.std, -NORMALISED_LIMIT, NORMALISED_LIMIT)
        if not self.drives:
            return normalised
        return torch.cat([normalised, observations[:, list(DRIVES)]], dim=1)


class Torsos(nn.Module):
    """Actor and critic: the actor sees the first ``visible`` channels, the critic all; drives pass by the actor."""

    def __init__(self, channels: int, visible: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.channels, self.visible = channels, visible
        self.latent_dim_pi = self.latent_dim_vf = hidden[-1]
        self.actor = tanh_layers([visible, *hidden])
        self.critic = tanh_layers([channels, *hidden])

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latents of actor (with drives) and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, features) to (n, hidden + 2)."""
        return torch.cat([self.actor(features[:, : self.visible]), features[:, self.channels :]], dim=1)

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, features) to (n, hidden)."""
        latent: torch.Tensor = self.critic(features[:, : self.channels])
        return latent


class DriveHead(nn.Module):
    """action = skip * drives + scale * linear(latent)."""

    def __init__(self, linear: nn.Linear, skip: float, scale: tuple[float, float]) -> None:
        super().__init__()
        self.linear, self.skip = linear, skip
        self.register_buffer("scale", torch.tensor(scale))

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Shape (n, hidden + 2) to (n, 2)."""
        drives = latent[:, -len(DRIVES) :]
        mean: torch.Tensor = self.skip * drives + self.scale * self.linear(latent[:, : -len(DRIVES)])
        return mean


class DrivePolicy(ActorCriticPolicy):
    """PPO's policy of :class:`Normalise`, :class:`Torsos` and :class:`DriveHead`."""

    def __init__(
        self,
        *args: Any,
        hidden: tuple[int, ...] = (128, 128),
        skip: float = 1.0,
        scale: tuple[float, float] = (0.05, 0.05),
        **kwargs: Any,
    ) -> None:
        self.hidden, self.skip, self.scale = hidden, skip, scale
        super().__init__(*args, features_extractor_class=Normalise, **kwargs)

    def _build_mlp_extractor(self) -> None:
        channels = self.features_dim - len(DRIVES)
        self.mlp_extractor = Torsos(channels, min(channels, len(HISTORY)), self.hidden)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        # The optimiser already holds the linear layer's parameters; the head only wraps them.
        self.action_net = DriveHead(self.action_net, self.skip, self.scale)
