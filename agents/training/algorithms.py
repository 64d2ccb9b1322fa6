"""From a recipe to an algorithm with stable-baselines3's interface, on the native batch."""

from __future__ import annotations

import inspect
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm

from cz_gym import CzVectorEnv
from cz_gym.agents import apg
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.sb3 import CzVecEnv

from .networks import AsymmetricPolicy, Normalise
from .recipes import APG, PPO, SAC, Recipe, Reinforcement
from .wrappers import ActionRepeat, TrainingReward


class SoftActorCritic(stable_baselines3.SAC):
    """Soft actor-critic whose first actions are those of its untrained policy, not uniform over the whole box."""

    def _sample_action(self, learning_starts: int, *arguments: Any, **options: Any) -> Any:
        return super()._sample_action(0, *arguments, **options)

    def begin_with(self, noise: float) -> None:
        """Set the untrained policy's standard deviation to ``noise`` and its mean near zero, for any observation."""
        actor: Any = self.actor
        with torch.no_grad():
            actor.log_std.bias.fill_(np.log(noise))
            for layer in (actor.log_std, actor.mu):
                layer.weight *= 0.1


def make_algorithm(recipe: Recipe, seed: int, done: int = 0) -> BaseAlgorithm:
    """The algorithm of a recipe for a training seed; a resumed one has taken ``done`` steps before."""
    torch.set_num_threads(1)  # small networks are quicker so
    torch.manual_seed(seed)
    env: Any
    made: BaseAlgorithm
    match recipe:
        case APG():
            env = CzVecEnv(CzVectorEnv.from_config(recipe.config, recipe.num_envs, AutoresetMode.SAME_STEP))
            made = _made(apg.APG, "RecurrentPolicy", env, recipe, seed, policy_kwargs={"betas": recipe.betas})
        case PPO():
            network = {"hidden": recipe.hidden, "log_std_init": float(np.log(recipe.noise))}
            made = _made(stable_baselines3.PPO, AsymmetricPolicy, _rewarded(recipe, seed + done), recipe, seed, network)
        case SAC():
            env = ActionRepeat(_rewarded(recipe, seed + done), recipe.action_repeat)
            sac = _made(SoftActorCritic, "MlpPolicy", env, recipe, seed, {"net_arch": list(recipe.hidden)})
            sac.begin_with(recipe.noise)
            made = sac
        case _:
            raise TypeError(f"no algorithm for a {type(recipe).__name__}")
    # The algorithm's constructor has set the slots' seeds to ``seed`` and those after it: neighbouring training seeds
    # would meet the same crystals, and a resumed run its first ones again.
    made.set_random_seed((seed * 10_007 + done) % (len(TRAINING_SEEDS) - recipe.num_envs))
    made.num_timesteps = done
    return made


def _rewarded(recipe: Reinforcement, stagger: int) -> Any:
    """The training crystals with the recipe's reward."""
    batch = CzVectorEnv.from_config(recipe.config, recipe.num_envs, AutoresetMode.SAME_STEP)
    return TrainingReward(CzVecEnv(batch, recipe.privileged_critic, stagger), recipe.gamma, recipe.failure_costs)


def _made(algorithm: Any, policy: Any, env: Any, recipe: Recipe, seed: int, policy_kwargs: dict[str, Any]) -> Any:
    """The algorithm, with those of the recipe's fields that are arguments of it."""
    known = {name for kind in algorithm.__mro__ for name in inspect.signature(kind.__init__).parameters}
    settings = {name: getattr(recipe, name) for name in asdict(recipe) if name in known}
    if isinstance(recipe, Reinforcement):
        settings["learning_rate"] = partial(linear, recipe.learning_rate, recipe.learning_rate / 20.0)
        policy_kwargs = {"features_extractor_class": Normalise, **policy_kwargs}
    return algorithm(policy, env, policy_kwargs=policy_kwargs, seed=seed, device="cpu", **settings)


def linear(start: float, end: float, left: float) -> float:
    """A linear schedule over the share of training that is left."""
    return end + (start - end) * left
