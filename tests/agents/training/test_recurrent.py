"""Recurrent PPO: its file does what sb3-contrib's policy does, sample by sample, and a run of it ends in an agent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")
from contracts import facts

from cz_gym.agents.agent_file.contract import make_contract
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training.export import exported
from cz_gym.agents.training.learners import make_training
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.observation import HISTORY

RECIPE = replace(settings.RecurrentPPO().recipe, num_envs=8, hidden=(5,))
SMALL = replace(settings.RecurrentPPO(), recipe=RECIPE, units=7, n_steps=16, batch_size=64, n_epochs=1, steps=256)
NAMES = [channel.name for channel in HISTORY]


@pytest.fixture(scope="module")
def learner() -> Any:
    training = make_training(SMALL, 0, None)
    training.learner.learn(SMALL.steps, callback=training.callbacks)
    return training.learner


@pytest.fixture(scope="module")
def agent(learner: Any) -> OnnxPolicy:
    content = exported(learner)
    return OnnxPolicy.of(make_contract(content, **facts(algorithm="ppo-recurrent")), content)


def test_the_file_acts_as_the_policy_does(learner: Any, agent: OnnxPolicy) -> None:
    assert agent.remembers == 2 * SMALL.units
    random = np.random.default_rng(1)
    theirs: Any = None
    ours: Any = None
    for k in range(6):
        observation = random.normal(0.0, 0.5, (3, len(HISTORY))).astype(np.float32)
        begins = np.array([k == 0, k in (0, 2), k in (0, 3)])
        moves, theirs = learner.policy.predict(observation, theirs, begins, deterministic=True)
        applied = observation[:, [NAMES.index("v_p"), NAMES.index("Q_H")]]
        scale = [SMALL.recipe.head.pull_scale, SMALL.recipe.head.heater_scale]
        action, ours = agent.predict(observation, ours, begins)
        assert action == pytest.approx(np.clip(applied + scale * moves, -1.0, 1.0), abs=2e-6)
        assert ours == pytest.approx(np.concatenate([theirs[0][-1], theirs[1][-1]], axis=1), abs=2e-6)


def test_what_it_remembers_matters(agent: OnnxPolicy) -> None:
    observation = np.zeros((1, len(HISTORY)), np.float32)
    first, state = agent.predict(observation)
    second, _ = agent.predict(observation, state)
    again, _ = agent.predict(observation, state, np.array([True]))
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again)


def test_crystals_of_a_batch_do_not_meet(agent: OnnxPolicy) -> None:
    config = make_config("randomized", observation="history", horizon=300.0)
    together = rollout(agent, config, VALIDATION_SEEDS[:3])
    alone = rollout(agent, config, VALIDATION_SEEDS[2:3])
    assert together.signals.v_p[:, 2] == pytest.approx(alone.signals.v_p[:, 0], rel=1e-6)


def test_same_training_seed_same_agent(learner: Any) -> None:
    training = make_training(SMALL, 0, None)
    training.learner.learn(SMALL.steps, callback=training.callbacks)
    assert exported(training.learner) == exported(learner)
