"""Making learners: PPO, SAC and recurrent PPO on the native batch, as the settings say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO as PPOLearner
from stable_baselines3 import SAC as SACLearner
from stable_baselines3.common.callbacks import BaseCallback

from cz_gym import CzVectorEnv
from cz_gym.agents.policies.residual import ResidualAction
from cz_gym.config import Config
from cz_gym.episodes.scenario import Pullers, Scenario
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.evaluation.protocol import TRAINING_SEEDS

from . import recipes as settings
from .callbacks import CriticFirst, Statistics
from .imitation import Views, imitate, stand_beside
from .imitation_cache import imitate_once, kept_imitation
from .networks import DrivePolicy, Normalise
from .pairing import PairedReward
from .recurrent import make_recurrent
from .vec_env import CzVecEnv
from .wrappers import DriveAction, TrainingReward


@dataclass(frozen=True)
class Training:
    """A learner, ready to learn."""

    learner: Any
    callbacks: list[BaseCallback]
    recipe: settings.Recipe
    steps: int


def make_training(choice: settings.Choice, seed: int, logs: str | None, done: int = 0, teacher: Any = None) -> Training:
    """The learner of these settings for a training seed; ``done`` steps have been taken before (resuming).

    ``teacher`` is the controller that the settings name, for what is cloned or paired.
    """
    recipe = choice.recipe
    torch.set_num_threads(recipe.threads)
    torch.manual_seed(seed)
    slots = _make_slots(recipe, seed, done)
    if not isinstance(choice, settings.PPO):
        moves = _moves(choice, slots)
        rate = _linear(choice.learning_rate, choice.learning_rate / 20.0)
        if isinstance(choice, settings.SAC):
            other: Any = _make_sac(choice, moves, rate, seed, logs)
        else:
            other = make_recurrent(choice, moves, rate, seed, logs)
        _set_streams(other, seed, done)
        return Training(other, [Statistics(choice.steps // 4, done > 0)], recipe, choice.steps)
    learner = _make_ppo(choice, slots, seed, logs, teacher)
    _set_streams(learner, seed, done)
    critic_steps = min(choice.critic_steps, int(settings.CRITIC_SHARE * choice.steps))
    callbacks: list[BaseCallback] = [CriticFirst(critic_steps, choice.actor_pace)]
    if recipe.clone is None:
        callbacks.append(Statistics(choice.steps // 4, known=done > 0))
    return Training(learner, callbacks, recipe, choice.steps)


def clone(
    training: Training,
    teacher: Any,
    config: Config,
    seed: int,
    tell: Callable[[str], None],
    kept: Path | None = None,
) -> None:
    """Let a learner that has not learned yet imitate the teacher that its recipe names, or stand beside it.

    With ``kept``, a folder, an imitation of the same settings is made once and kept there.
    """
    recipe, policy = training.recipe, training.learner.policy
    choice = recipe.clone
    if choice is None:
        return
    scenario = training_scenario(recipe)
    own, wide = config.with_scenario(scenario), config.with_scenario(widened(scenario, choice.width))
    first = (seed * 20_011 + 500_000) % (len(TRAINING_SEEDS) - choice.rounds * choice.episodes)

    def begin() -> Views:
        if recipe.residual:
            return stand_beside(policy, teacher, wide, choice, first)
        return imitate(policy, teacher, own, wide, choice, first, tell)

    torch.manual_seed(seed)
    if kept is None:
        begin()
        return
    imitate_once(kept_imitation(kept, recipe, wide, seed), policy, begin)
    torch.manual_seed(seed)  # what follows does not depend on whether the imitation was kept


def training_scenario(recipe: settings.Recipe) -> Scenario:
    """The scenario with the pullers' spread that is trained on."""
    scenario = find_scenario(recipe.scenario)
    if recipe.width == 1.0:
        return scenario
    pullers = _spread(scenario.pullers, recipe.width)
    return replace(scenario, name=f"{scenario.name}-width-{recipe.width:g}", pullers=pullers)


def widened(scenario: Scenario, width: float) -> Scenario:
    """The scenario with its pullers, ramps, fluctuations and noises spread that many times as wide.

    A share of what an imitation is shown (``Clone.wide_share``): on crystals no worse than the scenario's own it never
    sees how the teacher saves one.
    """
    if width == 1.0:
        return scenario
    s = scenario

    def times(bounds: tuple[float, float]) -> tuple[float, float]:
        return width * bounds[0], width * bounds[1]

    return replace(
        s,
        name=f"{s.name}-times-{width:g}",
        pullers=replace(_spread(s.pullers, width), start_radius_sd=width * s.pullers.start_radius_sd),
        recipe=replace(s.recipe, rate=times(s.recipe.rate)),
        drift=replace(s.drift, amount=times(s.drift.amount)),
        interface=replace(s.interface, sd=times(s.interface.sd)),
        reference=replace(s.reference, amount=times(s.reference.amount)),
        sensor=replace(
            s.sensor, camera_noise=times(s.sensor.camera_noise), pyrometer_noise=times(s.sensor.pyrometer_noise)
        ),
    )


def _spread(pullers: Pullers, width: float) -> Pullers:
    """The pullers with their constants spread that many times as wide about the middle."""
    middle, half = sum(pullers.mix) / 2.0, (pullers.mix[1] - pullers.mix[0]) / 2.0
    return replace(
        pullers,
        mix=(max(middle - width * half, 0.0), min(middle + width * half, 1.0)),
        capillary=width * pullers.capillary,
        conductivity=width * pullers.conductivity,
        conductance=width * pullers.conductance,
    )


def _make_slots(recipe: settings.Recipe, seed: int, done: int) -> CzVecEnv:
    env = CzVectorEnv(
        recipe.num_envs,
        scenario=training_scenario(recipe),
        observation=recipe.observation,
        control_interval=recipe.control_interval,
        autoreset_mode=AutoresetMode.SAME_STEP,
        info="all",
    )
    return CzVecEnv(env, recipe.privileged_critic, stagger=seed + done)


def _set_streams(learner: Any, seed: int, done: int) -> None:
    """Give the learner's randomness and its slots seeds of this training seed, and new ones when it is resumed.

    Made learners have set the slots' seeds to ``seed`` and those after it: neighbouring training seeds would meet the
    same crystals, and a resumed run its first ones again.
    """
    learner.set_random_seed((seed * 10_007 + done) % (len(TRAINING_SEEDS) - learner.n_envs))


def _linear(start: float, end: float) -> Callable[[float], float]:
    """A schedule over the share of training left."""
    return lambda left: end + (start - end) * left


def _make_ppo(choice: settings.PPO, slots: CzVecEnv, seed: int, logs: str | None, teacher: Any) -> PPOLearner:
    recipe, head = choice.recipe, choice.recipe.head
    env: Any = TrainingReward(slots, choice.gamma, recipe.weights)
    if choice.paired:
        env = PairedReward(env, slots, teacher)
    if recipe.residual:
        env = ResidualAction(env, teacher)
    return PPOLearner(
        DrivePolicy,
        env,
        learning_rate=_linear(choice.learning_rate, choice.learning_rate / 20.0),
        n_steps=choice.n_steps,
        batch_size=choice.batch_size,
        n_epochs=choice.n_epochs,
        gamma=choice.gamma,
        gae_lambda=choice.gae_lambda,
        clip_range=choice.clip_range,
        ent_coef=choice.ent_coef,
        vf_coef=choice.vf_coef,
        max_grad_norm=choice.max_grad_norm,
        policy_kwargs={
            "hidden": recipe.hidden,
            "skip": head.skip,
            "scale": (head.pull_scale, head.heater_scale),
            "noise": choice.noise,
            "frozen": choice.frozen,
            "memory": recipe.memory,
        },
        seed=seed,
        device="cpu",
        tensorboard_log=logs,
    )


def _moves(choice: settings.SAC | settings.RecurrentPPO, slots: CzVecEnv) -> DriveAction:
    """The slots for networks that have no action head of their own."""
    recipe, head = choice.recipe, choice.recipe.head
    rewarded = TrainingReward(slots, choice.gamma, recipe.weights)
    return DriveAction(rewarded, head.skip, (head.pull_scale, head.heater_scale))


def _make_sac(
    choice: settings.SAC, env: DriveAction, rate: Callable[[float], float], seed: int, logs: str | None
) -> SACLearner:
    return SACLearner(
        "MlpPolicy",
        env,
        learning_rate=rate,
        buffer_size=choice.buffer_size,
        learning_starts=choice.learning_starts,
        batch_size=choice.batch_size,
        tau=choice.tau,
        gamma=choice.gamma,
        train_freq=1,
        gradient_steps=choice.gradient_steps,
        policy_kwargs={
            "net_arch": list(choice.recipe.hidden),
            "features_extractor_class": Normalise,
            "features_extractor_kwargs": {"drives": False},
        },
        seed=seed,
        device="cpu",
        tensorboard_log=logs,
    )
