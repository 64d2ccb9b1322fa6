"""What stands between the native batch and a learner: its reward, and how long it holds an action."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvWrapper

from cz_gym.cost import FAILURE_COST, Cost, cost_terms, reward

from .recipes import OWN_WEIGHTS, CostWeights
from .vec_env import CzVecEnv


class TrainingReward(VecEnvWrapper):
    """Reward for a discounting learner: scaled by 1 - gamma; a failure costs the worst step for the discounted rest.

    The environment's own failure penalty, -10 a lost step, is the same thing undiscounted. The terms of the cost are
    weighted as asked; the last step of an episode keeps the environment's own weights. Without ``failure_costs``,
    rewards are raised by what a step can cost, and failing ends them: what a learner gets who is paid to stay alive.
    """

    def __init__(
        self, slots: CzVecEnv, gamma: float, weights: CostWeights = OWN_WEIGHTS, failure_costs: bool = True
    ) -> None:
        super().__init__(slots)
        self.slots, self.weights = slots, weights
        self.share = 1.0 - gamma
        self.floor = -FAILURE_COST / self.share if failure_costs else -FAILURE_COST
        self.raised = 0.0 if failure_costs else FAILURE_COST

    def reset(self) -> Any:
        """Pass on."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Weigh and scale the reward."""
        observation, given, done, infos = self.venv.step_wait()
        if self.weights != OWN_WEIGHTS:
            given = np.where(done, given, self.reward(self.slots.info))
        earned = (np.maximum(given, self.floor) + self.raised) * self.share
        return observation, earned.astype(np.float32), done, infos

    def reward(self, info: dict[str, Any]) -> Any:
        """The weighed reward of a step from what the batch said of it."""
        weights, radius = self.weights, info["cost_radius"]
        if weights.observable:
            radius = cost_terms(info["r_c"] - info["r_ref"] + info["ring_offset"], 0.0, 0.0, 0.0).radius
        cost = Cost(
            radius,
            weights.pull * info["cost_pull"],
            weights.pull_step * info["cost_pull_step"],
            weights.heater_step * info["cost_heater_step"],
        )
        return reward(cost)


class Held(VecEnvWrapper):
    """Each action is held for ``times`` steps, and earns their mean reward.

    An episode that ends among them ends the transition; what the next one does until the action's end earns nothing.
    """

    def __init__(self, venv: VecEnv, times: int) -> None:
        super().__init__(venv)
        self.times = times

    def reset(self) -> Any:
        """Pass on."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self.actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Advance every slot by as many steps."""
        observation, earned, done, infos = self.venv.step_wait()
        for _ in range(self.times - 1):
            self.venv.step_async(self.actions)
            observation, more, over, others = self.venv.step_wait()
            earned = earned + np.where(done, np.float32(0.0), more)
            infos = [one if one else other for one, other in zip(infos, others, strict=True)]
            done = done | over
        return observation, earned / np.float32(self.times), done, infos
