"""PPO that goes on from an agent of the recipe ``gradient``: its memory before the learner, its law as the actor."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

from cz_gym.observation import HISTORY, to_measured

from .filter_bank import GAINS, STATE, FilterBank
from .networks import ActorCritic, Normalise
from .vec_env import CzVecEnv


class Remembering(VecEnvWrapper):
    """Gives the bank's features in place of the history; the true state behind it is kept for the critic."""

    def __init__(self, venv: CzVecEnv, bank: FilterBank) -> None:
        assert isinstance(venv.observation_space, Box)
        (channels,) = venv.observation_space.shape
        width = channels - len(HISTORY) + len(bank.mean)
        super().__init__(venv, Box(-np.inf, np.inf, (width,), np.float32))
        self.bank = bank

    def reset(self) -> Any:
        """Forget everything."""
        self._memory = torch.zeros(self.num_envs, STATE)
        return self._remembered(self.venv.reset())

    def step_wait(self) -> Any:
        """Remember what is seen; slots whose episode ended forget."""
        observation, earned, done, infos = self.venv.step_wait()
        for i in np.flatnonzero(done).tolist():
            last, _ = self._features(infos[i]["terminal_observation"][None], self._memory[i : i + 1])
            infos[i]["terminal_observation"] = last[0]
        self._memory[torch.from_numpy(done)] = 0.0
        return self._remembered(observation), earned, done, infos

    def _remembered(self, observation: Any) -> Any:
        features, self._memory = self._features(observation, self._memory)
        return features

    def _features(self, observation: Any, memory: torch.Tensor) -> tuple[Any, torch.Tensor]:
        measured = to_measured(observation[:, : len(HISTORY)])
        with torch.no_grad():
            features, after = self.bank.remember(torch.from_numpy(measured), memory)
        return np.concatenate([features.numpy(), observation[:, len(HISTORY) :]], axis=1), after


class Law(nn.Module):
    """The bank's law as the layer that gives the actions' mean."""

    def __init__(self, bank: FilterBank) -> None:
        super().__init__()
        self.bank = bank

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, width) to (n, 2)."""
        action: torch.Tensor = self.bank.act(features)
        return action


class Critic(ActorCritic):
    """The actor's features pass unchanged; the critic sees them and the true state, normalised."""

    def __init__(self, space: Any, measured: int, hidden: tuple[int, ...]) -> None:
        super().__init__(space.shape[0], measured, hidden)
        self.normalise = Normalise(space)
        self.policy_net, self.latent_dim_pi = nn.Sequential(), measured

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, hidden)."""
        return super().forward_critic(self.normalise(features))


class BankPolicy(ActorCriticPolicy):
    """PPO's policy around a :class:`.filter_bank.FilterBank`; ``noise`` is in units of its outputs."""

    mlp_extractor: Critic  # type: ignore[assignment]  # has all of MlpExtractor that ActorCriticPolicy uses

    def __init__(self, *arguments: Any, bank: FilterBank, hidden: tuple[int, ...], noise: float, **options: Any):
        # A list, since a module cannot be set before torch's own part is made.
        self._given, self._hidden, self._noise = [bank], hidden, noise
        super().__init__(*arguments, **options)

    @property
    def bank(self) -> FilterBank:
        """The actor."""
        return self._given[0]

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = Critic(self.observation_space, len(self.bank.mean), self._hidden)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = Law(self.bank)
        with torch.no_grad():
            self.log_std.copy_(torch.log(self._noise * torch.tensor(GAINS)))
        self.optimizer = self.optimizer_class(self.parameters(), **self.optimizer_kwargs)
