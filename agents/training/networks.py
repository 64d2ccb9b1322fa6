"""The policy network: an actor that moves the drives from where they are, a critic that may see more.

Actor: observation -> normalise -> (tanh layers -> linear) + linear -> two outputs;
action = skip * (applied v_p, Q_H) + scale * output. The linear path carries what a linear controller would do, the
layers what bends it. The applied drives stand in the observation, so that the actor is one function of it and exports
as one file.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from cz_gym.observation import HISTORY, LAGGED, LAGS, MEASURED

DRIVES = tuple([channel.name for channel in MEASURED].index(name) for name in ("v_p", "Q_H"))
"""Where an observation holds the applied drives, in action units."""
NORMALISED_LIMIT = 30.0


def seen_channels(channels: int, memory: float) -> npt.NDArray[np.float32]:
    """1 for what networks see, 0 for past samples older than ``memory`` [s], shape (channels,)."""
    seen = np.ones(channels, np.float32)
    lagged = seen[len(HISTORY) - len(LAGS) * len(LAGGED) : len(HISTORY)]
    if channels >= len(HISTORY):
        lagged[:] = np.repeat(np.array(LAGS) <= memory, len(LAGGED))
    return seen


def tanh_layers(sizes: list[int]) -> nn.Sequential:
    """Linear layers with tanh after each."""
    layers: list[nn.Module] = []
    for wide, narrow in pairwise(sizes):
        layers += [nn.Linear(wide, narrow), nn.Tanh()]
    return nn.Sequential(*layers)


class Normalise(BaseFeaturesExtractor):
    """Normalised observation, on request with the two applied drives appended raw; part of the saved policy."""

    def __init__(self, observation_space: Box, drives: bool = True, memory: float = LAGS[-1]) -> None:
        channels = observation_space.shape[0]
        super().__init__(observation_space, channels + (len(DRIVES) if drives else 0))
        self.drives = drives
        self.register_buffer("seen", torch.as_tensor(seen_channels(channels, memory)), persistent=False)
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("scaling", torch.eye(channels))

    def set(self, mean: np.ndarray, scaling: np.ndarray) -> None:
        """Set what observations are normalised with: (observation - mean) @ scaling, shapes (channels,) and square.

        Channels that are not seen count as their mean.
        """
        self.mean.copy_(torch.as_tensor(mean))
        self.scaling.copy_(torch.as_tensor(scaling))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, channels) or (n, channels + 2)."""
        centred = (observations - self.mean) * self.seen
        normalised = torch.clamp(centred @ self.scaling, -NORMALISED_LIMIT, NORMALISED_LIMIT)
        if not self.drives:
            return normalised
        return torch.cat([normalised, observations[:, list(DRIVES)]], dim=1)


class Torsos(nn.Module):
    """Actor and critic: the actor sees the first ``visible`` channels, the critic all; drives pass by the actor."""

    def __init__(self, channels: int, visible: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.channels, self.visible = channels, visible
        truths = channels - visible
        self.register_buffer("pairs", torch.triu_indices(truths, truths), persistent=False)
        self.latent_dim_pi = hidden[-1]
        self.latent_dim_vf = hidden[-1] + truths + self.pairs.shape[1]
        self.actor = tanh_layers([visible, *hidden])
        self.direct = nn.Linear(visible, len(DRIVES))
        nn.init.zeros_(self.direct.weight)
        nn.init.zeros_(self.direct.bias)
        self.critic = tanh_layers([channels, *hidden])
        self.still = False
        """Whether the actor's layers keep their weights: no gradient passes, nor counts where gradients are clipped."""

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latents of actor (with its linear path and drives) and critic."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, features) to (n, hidden + 4)."""
        seen = features[:, : self.visible]
        hidden = self.actor(seen)
        return torch.cat(
            [hidden.detach() if self.still else hidden, self.direct(seen), features[:, self.channels :]], dim=1
        )

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, features) to (n, hidden + true channels and their products)."""
        truths = features[:, self.visible : self.channels]
        products = truths[:, self.pairs[0]] * truths[:, self.pairs[1]]
        return torch.cat([self.critic(features[:, : self.channels]), truths, products], dim=1)


class DriveHead(nn.Module):
    """action = skip * drives + scale * (linear(latent) + direct)."""

    def __init__(self, linear: nn.Linear, skip: float, scale: tuple[float, float]) -> None:
        super().__init__()
        self.linear, self.skip = linear, skip
        self.register_buffer("scale", torch.tensor(scale))

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Shape (n, hidden + 4) to (n, 2)."""
        hidden, direct, drives = torch.tensor_split(latent, (-2 * len(DRIVES), -len(DRIVES)), dim=1)
        mean: torch.Tensor = self.skip * drives + self.scale * (self.linear(hidden) + direct)
        return mean


class Paced(torch.optim.Adam):
    """Adam whose groups of parameters learn at a ``pace`` of their own: a share of the scheduled learning rate."""

    def step(self, closure: Any = None) -> Any:
        """One update."""
        scheduled = [group["lr"] for group in self.param_groups]
        for group in self.param_groups:
            group["lr"] *= group["pace"]
        result = super().step(closure)
        for group, rate in zip(self.param_groups, scheduled, strict=True):
            group["lr"] = rate
        return result


class DrivePolicy(ActorCriticPolicy):
    """PPO's policy of :class:`Normalise`, :class:`Torsos` and :class:`DriveHead`."""

    def __init__(
        self,
        *args: Any,
        hidden: tuple[int, ...] = (128, 128),
        skip: float = 1.0,
        scale: tuple[float, float] = (0.05, 0.05),
        noise: tuple[float, float] = (0.05, 0.05),
        frozen: tuple[str, ...] = (),
        memory: float = LAGS[-1],
        **kwargs: Any,
    ) -> None:
        self.hidden, self.skip, self.scale, self.noise, self.frozen = hidden, skip, scale, noise, frozen
        self.memory = memory
        seeing = {"memory": memory}
        super().__init__(*args, features_extractor_class=Normalise, features_extractor_kwargs=seeing, **kwargs)

    def _build_mlp_extractor(self) -> None:
        channels = self.features_dim - len(DRIVES)
        self.mlp_extractor = Torsos(channels, min(channels, len(HISTORY)), self.hidden)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = DriveHead(self.action_net, self.skip, self.scale)
        with torch.no_grad():
            self.log_std.copy_(torch.log(torch.tensor(self.noise)))
        critic = [*self.mlp_extractor.critic.parameters(), *self.value_net.parameters()]
        outputs = [*self.mlp_extractor.direct.parameters(), *self.action_net.parameters()]
        actor = [*outputs, self.log_std]
        self.mlp_extractor.still = "layers" in self.frozen
        if not self.mlp_extractor.still:
            actor += self.mlp_extractor.actor.parameters()
        if "heater" in self.frozen:
            for parameter in outputs:
                parameter.register_hook(_without_heater)
        groups = [{"params": critic, "pace": 1.0}, {"params": actor, "pace": 1.0}]
        self.optimizer = Paced(groups, lr_schedule(1.0), eps=1e-5)

    def set_actor_pace(self, pace: float) -> None:
        """Let the actor learn at this share of the learning rate."""
        self.optimizer.param_groups[1]["pace"] = pace


def _without_heater(gradient: torch.Tensor) -> torch.Tensor:
    return torch.cat([gradient[:1], torch.zeros_like(gradient[1:])])
