"""Variance reduction: the reward less what a teacher earns at the same moment of the same crystal.

Most of a reward's spread is the crystal's, not the agent's. A second batch with the same seeds, driven by the teacher,
has the same spread; what it earns does not depend on the agent's actions, so that taking it off changes no gradient's
expectation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from cz_gym import CzVectorEnv

from .vec_env import CzVecEnv
from .wrappers import TrainingReward


class PairedReward(VecEnvWrapper):
    """Around a :class:`cz_gym.agents.training.wrappers.TrainingReward`: takes the teacher's reward off.

    A slot whose two crystals have come apart, because the teacher lost one, gets its mean reward taken off instead.
    """

    def __init__(self, venv: TrainingReward, slots: CzVecEnv, teacher: Any) -> None:
        super().__init__(venv)
        self.weighing, self.slots, self.teacher = venv, slots, teacher
        config = slots.env.config
        self.twin = CzVectorEnv(
            slots.num_envs,
            scenario=config.scenario,
            control_interval=config.control_interval,
            autoreset_mode=AutoresetMode.SAME_STEP,
            info="all",
        )
        self.together = np.ones(slots.num_envs, np.bool_)
        self._begins = np.ones(slots.num_envs, np.bool_)
        self._seen: Any = None
        self._memory: Any = None

    def reset(self) -> Any:
        """Begin both batches with the same seeds."""
        seeds = list(self.slots._seeds)
        observation = self.venv.reset()
        self._seen, _ = self.twin.reset(seed=seeds)
        self._memory = None
        self._begins[:] = self.together[:] = True
        return observation

    def step_wait(self) -> Any:
        """The agent's step, then the teacher's."""
        observation, reward, done, infos = self.venv.step_wait()
        action, self._memory = self.teacher.predict(self._seen, self._memory, self._begins)
        self._seen, _, terminated, truncated, info = self.twin.step(action)
        rival = self.weighing.reward(info) * self.weighing.share
        over = terminated | truncated
        self.together &= done | ~over
        late = done & ~over
        if late.any():
            fresh, _ = self.twin.reset(options={"reset_mask": late.copy()})
            self._seen = np.where(late[:, None], fresh, self._seen)
        self._begins = over | late
        compared = self.together & ~done
        mean = rival[compared].mean() if compared.any() else 0.0
        return observation, reward - np.where(compared, rival, mean).astype(np.float32), done, infos

    def close(self) -> None:
        """Close both batches."""
        self.twin.close()
        self.venv.close()
