"""Learning from reward: stable-baselines3's algorithms on the native batch."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import asdict, replace
from operator import attrgetter
from typing import Any

import numpy as np
import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.logger import Logger

from cz_gym import CzVectorEnv
from cz_gym.cost import WEIGHTS
from cz_gym.evaluation.protocol import TRAINING_SEEDS

from .callbacks import Statistics
from .export import actor_of, actor_onnx
from .learner import Parts, Watch
from .networks import AsymmetricPolicy, Normalise
from .recipes import PPO, SAC, Reinforcement
from .vec_env import CzVecEnv
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


class ReinforcementLearner:
    """A learner around an algorithm of stable-baselines3; a resumed one has taken ``done`` steps before."""

    def __init__(self, recipe: Reinforcement, seed: int, logger: Logger, done: int) -> None:
        torch.set_num_threads(recipe.threads)
        self.recipe, self.total, self.logger = recipe, recipe.steps, logger
        self.algorithm = make_algorithm(recipe, make_slots(recipe, seed, done), seed)
        # The algorithm's constructor has set the slots' seeds to ``seed`` and those after it: neighbouring training
        # seeds would meet the same crystals, and a resumed run its first ones again.
        self.algorithm.set_random_seed((seed * 10_007 + done) % (len(TRAINING_SEEDS) - recipe.num_envs))
        self.algorithm.num_timesteps = done
        self.algorithm.set_logger(logger)
        self._statistics = Statistics(recipe.steps // 4, recipe.basis, known=done > 0)

    @property
    def steps(self) -> int:
        """Environment steps taken."""
        return self.algorithm.num_timesteps

    def learn(self, watch: Watch) -> None:
        """Take the steps that are left."""

        def watched(*_: Any) -> bool:
            watch(self.steps, "")
            return True

        left = self.total - self.steps
        if left > 0:
            self.algorithm.learn(left, [self._statistics, ConvertCallback(watched)], reset_num_timesteps=False)

    def parts(self) -> Parts:
        """Networks, optimisers, lone variables and the replay buffer of the algorithm."""
        states, lone = self.algorithm._get_torch_save_params()
        parts: dict[str, Any] = {name: attrgetter(name)(self.algorithm) for name in states}
        optimisers = {name: part for name, part in parts.items() if isinstance(part, torch.optim.Optimizer)}
        modules = {name: part for name, part in parts.items() if name not in optimisers}
        variables = {name: attrgetter(name)(self.algorithm) for name in lone}
        return Parts(modules, optimisers, variables, getattr(self.algorithm, "replay_buffer", None))

    def exported(self) -> bytes:
        """The deterministic actor, a serialised ONNX model."""
        return actor_onnx(actor_of(self.algorithm.policy))


def make_slots(recipe: Reinforcement, seed: int, done: int) -> CzVecEnv:
    """The batch of training crystals."""
    config = replace(recipe.config, horizon=recipe.episode_length)
    info = "lean" if recipe.weights == WEIGHTS and not recipe.observable else "all"
    env = CzVectorEnv.from_config(config, recipe.num_envs, AutoresetMode.SAME_STEP, info=info)
    return CzVecEnv(env, recipe.privileged_critic, stagger=seed + done)


def make_algorithm(recipe: Reinforcement, slots: CzVecEnv, seed: int) -> BaseAlgorithm:
    """The algorithm of a recipe, whose fields it takes by stable-baselines3's names."""
    torch.manual_seed(seed)
    env: Any = TrainingReward(slots, recipe.gamma, recipe.weights, recipe.observable, recipe.failure_costs)
    network = {"features_extractor_class": Normalise, "features_extractor_kwargs": {"memory": recipe.memory}}
    if isinstance(recipe, SAC):
        options = {**network, "net_arch": list(recipe.hidden)}
        sac: SoftActorCritic = _made(
            SoftActorCritic, "MlpPolicy", ActionRepeat(env, recipe.action_repeat), options, recipe, seed
        )
        sac.begin_with(recipe.noise)
        return sac
    if isinstance(recipe, PPO):
        options = {**network, "hidden": recipe.hidden, "log_std_init": float(np.log(recipe.noise))}
        ppo: stable_baselines3.PPO = _made(stable_baselines3.PPO, AsymmetricPolicy, env, options, recipe, seed)
        return ppo
    raise TypeError(f"no algorithm for a {type(recipe).__name__}")


def _made(
    algorithm: Any, policy: Any, env: Any, policy_options: dict[str, Any], recipe: Reinforcement, seed: int
) -> Any:
    known = {name for kind in algorithm.__mro__ for name in inspect.signature(kind.__init__).parameters}
    settings = {name: value for name, value in asdict(recipe).items() if name in known}
    settings["learning_rate"] = linear(recipe.learning_rate, recipe.learning_rate / 20.0)
    return algorithm(policy, env, policy_kwargs=policy_options, seed=seed, device="cpu", **settings)


def linear(start: float, end: float) -> Callable[[float], float]:
    """A linear schedule over the share of training that is left."""
    return lambda left: end + (start - end) * left
