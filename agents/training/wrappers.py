"""Wrappers between the native batch and a learner: the training reward, and repeated actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvWrapper

from cz_gym.cost import FAILURE_COST


class TrainingReward(VecEnvWrapper):
    """Reward for a discounting learner: scaled by 1 - gamma; a failure costs the worst step for the discounted rest.

    The environment's own failure penalty, -10 a lost step, is the same thing undiscounted. Without ``failure_costs``
    every reward is raised to be positive, and a failure only ends the rewards.
    """

    def __init__(self, venv: VecEnv, gamma: float, failure_costs: bool = True) -> None:
        super().__init__(venv)
        self.scale = 1.0 - gamma
        self.floor = -FAILURE_COST / self.scale if failure_costs else -FAILURE_COST
        self.raised = 0.0 if failure_costs else FAILURE_COST

    def reset(self) -> Any:
        """Reset every slot."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Advance every slot; scale the reward."""
        observation, given, done, infos = self.venv.step_wait()
        earned = (np.maximum(given, self.floor) + self.raised) * self.scale
        return observation, earned.astype(np.float32), done, infos


class ActionRepeat(VecEnvWrapper):
    """Repeats each action for ``times`` steps; the reward is the mean of theirs.

    An episode that ends among these steps ends the transition; the steps of the next episode until the action's end
    earn nothing.
    """

    def __init__(self, venv: VecEnv, times: int) -> None:
        super().__init__(venv)
        self.times = times

    def reset(self) -> Any:
        """Reset every slot."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self.actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Advance every slot by ``times`` steps."""
        observation, earned, done, infos = self.venv.step_wait()
        for _ in range(self.times - 1):
            self.venv.step_async(self.actions)
            observation, more, over, others = self.venv.step_wait()
            earned = earned + np.where(done, np.float32(0.0), more)
            infos = [one if one else other for one, other in zip(infos, others, strict=True)]
            done = done | over
        return observation, earned / np.float32(self.times), done, infos
