"""Augmented random search (Mania, Guy, Recht 2018) of a linear policy on whitened observations.

The algorithm is sb3-contrib's; what is ours is that all candidates act at once in the native batch, each slot by its
own candidate, and that all meet the same crystals: what differs between them is the policy alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from sb3_contrib import ARS
from sb3_contrib.ars.policies import ARSLinearPolicy
from torch import nn

from cz_gym.cost import FAILURE_COST
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.observation import HISTORY

from .networks import Normalise, whitening

SAMPLES = 30
"""Observations of every so many steps are whitened with."""


class WhitenedLinearPolicy(ARSLinearPolicy):
    """action = W (whitened observation), within the box."""

    features_extractor: Normalise

    def make_features_extractor(self) -> Normalise:
        """Instead of sb3-contrib's flattening."""
        assert isinstance(self.observation_space, Box)
        return Normalise(self.observation_space)


class RandomSearch(ARS):
    """ARS whose candidates act side by side: slots in groups of one candidate, the same crystals in every group."""

    policy: WhitenedLinearPolicy
    weights: torch.Tensor  # type: ignore[assignment]  # None before its first round, said the library

    def __init__(self, *arguments: Any, part: int, **options: Any) -> None:
        self.part = part
        """Steps of an episode that candidates are compared on."""
        self.rounds, self.mean, self.spread = 0, np.zeros(len(HISTORY)), np.zeros((len(HISTORY), len(HISTORY)))
        super().__init__(*arguments, **options)

    def _do_one_update(self, callback: Any, async_eval: Any) -> None:
        # A checkpoint holds the policy, not this copy of it.
        self.weights = nn.utils.parameters_to_vector(self.policy.parameters()).detach()
        super()._do_one_update(callback, async_eval)

    def evaluate_candidates(self, candidate_weights: torch.Tensor, callback: Any, async_eval: Any) -> torch.Tensor:
        """The return of each candidate over a part of an episode, the mean of its crystals; shape (candidates,).

        A lost crystal earns the failing step's reward in each step lost.
        """
        env: Any = self.env
        crystals = env.num_envs // self.pop_size
        weights = candidate_weights.reshape(self.pop_size, 2, -1).repeat_interleave(crystals, 0).numpy()
        env.seed_slots(np.tile(np.random.choice(TRAINING_SEEDS, crystals), self.pop_size).tolist())
        observation, returns, alive = env.reset(), np.zeros(env.num_envs), np.ones(env.num_envs, np.bool_)
        seen = []
        callback.on_rollout_start()
        for step in range(self.part):
            if step % SAMPLES == 0:
                seen.append(observation[alive])
            with torch.no_grad():
                x = self.policy.features_extractor(torch.as_tensor(observation)).numpy()
            observation, reward, done, _ = env.step(np.clip(np.einsum("nac,nc->na", weights, x), -1.0, 1.0))
            alive &= ~done | (reward > -FAILURE_COST)
            returns += np.where(alive, reward, -FAILURE_COST)
            self.num_timesteps += env.num_envs
            callback.on_step()
        self._whiten(np.concatenate(seen))
        callback.on_rollout_end()
        return torch.as_tensor(returns.reshape(self.pop_size, crystals).mean(axis=1), dtype=torch.float32)

    def _whiten(self, seen: npt.NDArray[Any]) -> None:
        """Whiten with what has been seen, until a quarter of the training; weights go on meaning what they did."""
        normalise = self.policy.features_extractor
        if self._current_progress_remaining < 0.75 and normalise.mean.any():
            return
        self.rounds += 1
        mean, spread = seen.mean(axis=0, dtype=np.float64), np.cov(seen.T.astype(np.float64))
        # The first rounds, of lost crystals, are forgotten: beside them all that follow would look alike.
        share = max(1.0 / self.rounds, 0.1)
        self.mean += share * (mean - self.mean)
        self.spread += share * (spread - self.spread)
        before, after = normalise.scaling.numpy().astype(np.float64), whitening(self.spread)
        normalise.set(self.mean, after)
        if self.rounds > 1:
            weights = self.weights.reshape(2, -1).numpy() @ before.T @ np.linalg.inv(after).T
            self.weights = torch.as_tensor(weights.reshape(-1), dtype=torch.float32)
