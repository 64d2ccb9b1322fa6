"""A network beside a controller: its action is added to the controller's, in training and in use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from cz_gym.observation import HISTORY


@dataclass(frozen=True)
class Residual:
    """The sum of a controller's and an agent's actions, both ``predict`` on "history"; the controller remembers."""

    base: Any
    agent: Any

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Actions, shape (n, 2), of observations of shape (n, channels)."""
        action, state = self.base.predict(observation, state, episode_start)
        added, _ = self.agent.predict(observation)
        return np.clip(action + added, -1.0, 1.0).astype(np.float32), state


class ResidualAction(VecEnvWrapper):
    """Adds the controller's action to the learner's."""

    def __init__(self, venv: VecEnv, base: Any) -> None:
        super().__init__(venv)
        self.base = base
        self._memory: Any = None
        self._action: Any = None

    def reset(self) -> Any:
        """Begin, with a controller that remembers nothing."""
        self._memory = None
        return self._answered(self.venv.reset(), np.ones(self.num_envs, np.bool_))

    def step_async(self, actions: np.ndarray) -> None:
        """Act."""
        self.venv.step_async(np.clip(self._action + actions, -1.0, 1.0).astype(np.float32))

    def step_wait(self) -> Any:
        """Pass on, and have the controller answer."""
        observation, reward, done, infos = self.venv.step_wait()
        return self._answered(observation, done), reward, done, infos

    def _answered(self, observation: Any, begins: Any) -> Any:
        self._action, self._memory = self.base.predict(observation[:, : len(HISTORY)], self._memory, begins)
        return observation
