"""From a recipe to an algorithm with stable-baselines3's interface, on the native batch."""

import inspect
from dataclasses import asdict
from functools import partial
from typing import Any

import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from cz_gym import CzVectorEnv
from cz_gym.agents import apg
from cz_gym.agents.asymmetric import AsymmetricPolicy, AsymmetricSACPolicy
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.sb3 import ActionRepeat, CzVecEnv

from .recipes import APG, PPO, SAC, Recipe, Reinforcement


def make_algorithm(recipe: Recipe, seed: int, done: int = 0) -> BaseAlgorithm:
    """The algorithm of a recipe for a training seed; a resumed one has taken ``done`` steps before."""
    torch.set_num_threads(1)  # small networks are quicker so
    torch.manual_seed(seed)
    learns = isinstance(recipe, Reinforcement)
    told = isinstance(recipe, Reinforcement) and recipe.told
    batch = CzVectorEnv.from_config(
        recipe.config, recipe.num_envs, AutoresetMode.SAME_STEP, info="all" if told else "lean"
    )
    env: VecEnv = CzVecEnv(batch, seed + done if learns else None, critic_state=told)
    kind: Any
    policy: Any
    options = dict[str, Any]()
    match recipe:
        case APG():
            kind, policy, options = apg.APG, "RecurrentPolicy", {"betas": recipe.betas}
        case PPO():
            kind, policy, critics = stable_baselines3.PPO, AsymmetricPolicy if told else "MlpPolicy", "vf"
            options = {"log_std_init": recipe.log_std_init}
        case SAC():
            kind, policy, critics = stable_baselines3.SAC, AsymmetricSACPolicy, "qf"
            options = {"activation_fn": torch.nn.Tanh}
        case _:
            raise TypeError(f"no algorithm for a {type(recipe).__name__}")
    known = {name for each in kind.__mro__ for name in inspect.signature(each.__init__).parameters}
    settings = {name: getattr(recipe, name) for name in asdict(recipe) if name in known}
    if isinstance(recipe, Reinforcement):
        env = ActionRepeat(env, recipe.action_repeat)
        env = VecNormalize(env, norm_obs=False, gamma=recipe.gamma)
        settings["learning_rate"] = partial(linear, recipe.learning_rate)
        options["net_arch"] = {"pi": list(recipe.hidden), critics: list(recipe.critic_hidden)}
    if isinstance(recipe, SAC):  # a resumed one first fills a new replay buffer
        settings["learning_starts"] += done // recipe.action_repeat
    made: BaseAlgorithm = kind(policy, env, policy_kwargs=options, seed=seed, device="cpu", **settings)
    # The algorithm's constructor has set the slots' seeds to ``seed`` and those after it: neighbouring training seeds
    # would meet the same crystals, and a resumed run its first ones again.
    made.set_random_seed((seed * 10_007 + done) % (len(TRAINING_SEEDS) - recipe.num_envs))
    made.num_timesteps = done // repeat_of(recipe)
    return made


def repeat_of(recipe: Recipe) -> int:
    """Environment steps of each of the algorithm's time steps."""
    return recipe.action_repeat if isinstance(recipe, Reinforcement) else 1


def linear(start: float, left: float) -> float:
    """A learning rate that falls linearly with the share of training that is left, to a twentieth."""
    return start * (0.05 + 0.95 * left)
