"""Recurrent PPO: its file does what sb3-contrib's policy does, sample by sample, and a run of it ends in an agent."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")
from cz_gym.agents.agent_file.contract import make_contract
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import RecurrentPPO
from cz_gym.baselines.registry import make_controller
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.observation import HISTORY
from tests.contracts import facts

SMALL = RecurrentPPO(num_envs=8, hidden=(5,), units=7, n_steps=16, batch_size=64, n_epochs=1, steps=256)


def trained() -> Any:
    learner: Any = make_learner(SMALL, 0, make_controller)
    learner.learn(lambda steps, doing: None)
    return learner


@pytest.fixture(scope="module")
def learner() -> Any:
    return trained()


@pytest.fixture(scope="module")
def agent(learner: Any) -> OnnxPolicy:
    content = learner.exported()
    return OnnxPolicy.of(make_contract(content, **facts(algorithm="ppo-recurrent", action="smooth")), content)


def test_the_file_acts_as_the_policy_does(learner: Any, agent: OnnxPolicy) -> None:
    assert agent.remembers == 2 * SMALL.units
    random = np.random.default_rng(1)
    theirs: Any = None
    ours: Any = None
    for k in range(6):
        observation = random.normal(0.0, 0.5, (3, len(HISTORY))).astype(np.float32)
        begins = np.array([k == 0, k in (0, 2), k in (0, 3)])
        moves, theirs = learner.algorithm.policy.predict(observation, theirs, begins, deterministic=True)
        action, ours = agent.predict(observation, ours, begins)
        assert action == pytest.approx(moves, abs=2e-6)
        assert ours == pytest.approx(np.concatenate([theirs[0][-1], theirs[1][-1]], axis=1), abs=2e-6)


def test_what_it_remembers_matters(agent: OnnxPolicy) -> None:
    observation = np.zeros((1, len(HISTORY)), np.float32)
    first, state = agent.predict(observation)
    second, _ = agent.predict(observation, state)
    again, _ = agent.predict(observation, state, np.array([True]))
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again)


def test_crystals_of_a_batch_do_not_meet(agent: OnnxPolicy) -> None:
    config = make_config("randomized", observation="history", action="smooth", horizon=300.0)
    together = rollout(agent, config, VALIDATION_SEEDS[:3])
    alone = rollout(agent, config, VALIDATION_SEEDS[2:3])
    assert together.signals.v_p[:, 2] == pytest.approx(alone.signals.v_p[:, 0], rel=1e-6)


def test_same_training_seed_same_agent(learner: Any) -> None:
    assert trained().exported() == learner.exported()
