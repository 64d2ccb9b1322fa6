"""Learning from reward: stable-baselines3's algorithms on the native batch, as the recipes say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from operator import attrgetter
from typing import Any

import numpy as np
import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode
from sb3_contrib import RecurrentPPO as RecurrentPPOAlgorithm
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from cz_gym import CzVectorEnv
from cz_gym.evaluation.protocol import TRAINING_SEEDS

from .callbacks import Statistics, Watching
from .export import drive_policy_onnx, recurrent_onnx, sac_onnx
from .learner import Parts, Watch
from .networks import DrivePolicy, Normalise
from .recipes import PPO, SAC, OnPolicy, RecurrentPPO, Reinforcement
from .vec_env import CzVecEnv
from .wrappers import DriveAction, TrainingReward


class Reinforced:
    """A learner around an algorithm of stable-baselines3; ``done`` steps have been taken before (resuming)."""

    def __init__(self, recipe: Reinforcement, seed: int, logger: Logger, done: int) -> None:
        torch.set_num_threads(recipe.threads)
        self.recipe, self.total, self.logger = recipe, recipe.steps, logger
        self.algorithm, self._export = _made(recipe, make_slots(recipe, seed, done), seed)
        # Made algorithms have set the slots' seeds to ``seed`` and those after it: neighbouring training seeds would
        # meet the same crystals, and a resumed run its first ones again.
        slots = recipe.num_envs
        self.algorithm.set_random_seed((seed * 10_007 + done) % (len(TRAINING_SEEDS) - slots))
        self.algorithm.num_timesteps = done
        self.algorithm.set_logger(logger)
        self._statistics = Statistics(recipe.steps // 4, known=done > 0)

    @property
    def steps(self) -> int:
        """Environment steps taken."""
        return self.algorithm.num_timesteps

    def learn(self, watch: Watch) -> None:
        """Take the steps that are left."""
        left = self.total - self.steps
        if left > 0:
            self.algorithm.learn(left, callback=[self._statistics, Watching(watch)], reset_num_timesteps=False)

    def parts(self) -> Parts:
        """Networks, optimisers, lone variables and the replay buffer of the algorithm."""
        states, lone = self.algorithm._get_torch_save_params()
        found: dict[str, Any] = {name: attrgetter(name)(self.algorithm) for name in states}
        optimisers = {name: part for name, part in found.items() if isinstance(part, torch.optim.Optimizer)}
        modules = {name: part for name, part in found.items() if name not in optimisers}
        variables = {name: attrgetter(name)(self.algorithm) for name in lone}
        return Parts(modules, optimisers, variables, getattr(self.algorithm, "replay_buffer", None))

    def exported(self) -> bytes:
        """The deterministic actor."""
        return self._export()


def make_slots(recipe: Reinforcement, seed: int, done: int) -> CzVecEnv:
    """The batch that is trained on."""
    env = CzVectorEnv(
        recipe.num_envs,
        scenario=recipe.scenario,
        observation=recipe.observation,
        control_interval=recipe.control_interval,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    return CzVecEnv(env, recipe.privileged_critic, stagger=seed + done)


def _made(recipe: Reinforcement, slots: CzVecEnv, seed: int) -> tuple[BaseAlgorithm, Callable[[], bytes]]:
    """The algorithm of a recipe, and what exports its actor."""
    torch.manual_seed(seed)
    rewarded = TrainingReward(slots, recipe.gamma, recipe.weights)
    common = {
        "learning_rate": _linear(recipe.learning_rate, recipe.learning_rate / 20.0),
        "batch_size": recipe.batch_size,
        "gamma": recipe.gamma,
        "seed": seed,
        "device": "cpu",
    }
    if isinstance(recipe, PPO):
        ppo = _ppo(recipe, rewarded, common)
        policy: Any = ppo.policy
        return ppo, lambda: drive_policy_onnx(policy)
    moves = DriveAction(rewarded, recipe.head.skip, recipe.head.scale)
    if isinstance(recipe, RecurrentPPO):
        recurrent = _recurrent_ppo(recipe, moves, common)
        return recurrent, lambda: recurrent_onnx(recurrent)
    if isinstance(recipe, SAC):
        sac = _sac(recipe, moves, common)
        return sac, lambda: sac_onnx(sac)
    raise TypeError(f"no algorithm learns by a {type(recipe).__name__}")


def _ppo(recipe: PPO, env: TrainingReward, common: dict[str, Any]) -> BaseAlgorithm:
    kwargs = {
        "hidden": recipe.hidden,
        "skip": recipe.head.skip,
        "scale": recipe.head.scale,
        "noise": recipe.noise,
        "memory": recipe.memory,
    }
    return stable_baselines3.PPO(DrivePolicy, env, policy_kwargs=kwargs, **common, **_on_policy(recipe))


def _recurrent_ppo(recipe: RecurrentPPO, env: DriveAction, common: dict[str, Any]) -> BaseAlgorithm:
    kwargs = {
        "net_arch": {"pi": list(recipe.hidden), "vf": list(recipe.hidden)},
        "lstm_hidden_size": recipe.units,
        "log_std_init": float(np.log(recipe.noise)),
        **_normalised(recipe),
    }
    return RecurrentPPOAlgorithm("MlpLstmPolicy", env, policy_kwargs=kwargs, **common, **_on_policy(recipe))


def _sac(recipe: SAC, env: DriveAction, common: dict[str, Any]) -> BaseAlgorithm:
    return stable_baselines3.SAC(
        "MlpPolicy",
        env,
        buffer_size=recipe.buffer_size,
        learning_starts=recipe.learning_starts,
        tau=recipe.tau,
        train_freq=1,
        gradient_steps=recipe.gradient_steps,
        policy_kwargs={"net_arch": list(recipe.hidden), **_normalised(recipe)},
        **common,
    )


def _on_policy(recipe: OnPolicy) -> dict[str, Any]:
    """The settings that PPO and recurrent PPO share, by stable-baselines3's names."""
    names = ("n_steps", "n_epochs", "gae_lambda", "clip_range", "ent_coef", "vf_coef", "max_grad_norm")
    return {name: value for name, value in asdict(recipe).items() if name in names}


def _normalised(recipe: Reinforcement) -> dict[str, Any]:
    """Normalised observations for a policy of stable-baselines3's own."""
    seeing = {"drives": False, "memory": recipe.memory}
    return {"features_extractor_class": Normalise, "features_extractor_kwargs": seeing}


def _linear(start: float, end: float) -> Callable[[float], float]:
    """A schedule over the share of training left."""
    return lambda left: end + (start - end) * left
