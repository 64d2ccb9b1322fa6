"""Agents that add to a controller: within limits, as they were trained, and to that controller alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cz_gym.agents import AgentFileError, OnnxPolicy
from cz_gym.agents.contract import agent_files
from cz_gym.agents.from_sb3 import to_agent
from cz_gym.agents.recipes import PPOResidual, make_algorithm
from cz_gym.agents.residual import Residual
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.sb3 import AddToController, make_vec_env
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.tools import benchmark, train
from cz_gym.tools.registry import load_agent, make_base, make_controller

SMALL = PPOResidual(num_envs=8, n_steps=8, batch_size=32, n_epochs=1, hidden=(8,), scenario="randomized")
SEEDS = VALIDATION_SEEDS[:3]
MINE = """
import numpy as np
class Mine:
    "Proportional, on the 12 channels of measured alone."
    gain = 0.02
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert observation.shape[-1] == WIDTH
        return np.clip(self.gain * observation[..., :1] * [1.0, 0.5], -1.0, 1.0), state
"""


def bold(recipe, seed=0):
    """An agent of a recipe whose untrained network asks for much, and its algorithm."""
    algorithm = make_algorithm(recipe, seed, 0, make_base(recipe.controller, recipe.config))
    with torch.no_grad():
        algorithm.policy.action_net.bias.copy_(torch.tensor([0.7, -5.0]))
        algorithm.policy.action_net.weight.mul_(100.0)
    return to_agent(algorithm, recipe.name, seed, recipe.config, None, "agent.onnx"), algorithm


@pytest.fixture(scope="module")
def agent():
    return bold(SMALL)[0]


@pytest.mark.parametrize("told", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_at_limits_of_zero_it_is_the_controller_bit_for_bit(told):
    agent, _ = bold(replace(SMALL, limits=(0.0, 0.0), told=told))
    config = SMALL.config
    pid = make_controller("pid-conventional", replace(config, observation="measured"))
    for each in (config.with_scenario("puller"), config):
        one, other = (rollout(policy, each, SEEDS, designed_for=config) for policy in (agent, pid))
        np.testing.assert_array_equal(np.stack(one.signals), np.stack(other.signals))
        np.testing.assert_array_equal(one.reward, other.reward)
    row = rollout(pid, replace(config, observation="measured"), SEEDS)  # the other observation rounds otherwise
    np.testing.assert_allclose(row.signals.r_c, one.signals.r_c, rtol=1e-6)


def test_what_is_added_stays_within_the_limits_and_comes_slowly(agent):
    config, residual = SMALL.config, agent.residual
    largest, memory = np.zeros(2), None
    observation = np.zeros((4, agent.contract.channels), np.float32)
    for k in range(1, 400):
        action, memory = agent.predict(observation, memory, np.full(4, k == 1))
        added = np.asarray(action) - memory.asked
        largest = np.maximum(largest, np.abs(added).max(axis=0))
        np.testing.assert_allclose(added[:, 1], -0.1 * (1.0 - np.exp(-k * config.control_interval / 50.0)), atol=1e-6)
    np.testing.assert_allclose(residual.limits, (0.1, 0.1), rtol=1e-6)
    assert (largest > 0.0).all()
    assert (largest <= residual.limits + 1e-6).all()
    alone, _ = agent.predict(observation[0], None, None)
    assert alone.shape == (2,)


def test_the_agent_acts_as_its_policy_does_in_training(agent):
    _, algorithm = bold(SMALL)
    residual, n = agent.residual, len(SEEDS)
    env = AddToController(make_vec_env(n, observation="history", action="direct", critic_state=True), residual)
    env.seed(list(SEEDS))
    observation, earned = env.reset(), []
    for _ in range(200):
        action, _ = algorithm.predict(observation, deterministic=True)
        observation, reward, _, _ = env.step(action)
        earned.append(reward)
    run = rollout(agent, SMALL.config, SEEDS)
    np.testing.assert_allclose(earned, run.reward[:200], rtol=1e-4, atol=1e-5)


def test_the_controller_begins_anew_with_each_crystal(agent):
    env = AddToController(make_vec_env(2, observation="history", action="direct", horizon=50.0), agent.residual)
    env.seed([5, 6])
    first = env.reset()
    for _ in range(10):
        observation, _, done, infos = env.step(np.ones((2, 2)))
    assert done.all()
    assert {each["terminal_observation"].shape for each in infos} == {first[0].shape}
    assert (infos[0]["terminal_observation"][2:4] > 0.0).all(), "shares in force at the end"
    fresh, _ = agent.residual.controller.predict(observation[:, 4:])
    np.testing.assert_array_equal(observation[:, :2], fresh)
    assert not observation[:, 2:4].any()


def test_only_the_controller_of_its_training_is_taken(agent, tmp_path):
    path = tmp_path / "agent.onnx"
    write_files(agent_files(path, agent.content, agent.contract))
    assert load_agent(path).contract == agent.contract
    with pytest.raises(AgentFileError, match=r"adds to the controller pid-conventional .*benchmark --agent runs both"):
        OnnxPolicy.load(path)
    other = make_base("paper-tuned", SMALL.config)
    with pytest.raises(AgentFileError, match=r"trained on the controller pid-conventional .*, not on paper-tuned "):
        OnnxPolicy.load(path, base=other)
    for name, said in (("lqg-true", "that read sensors"), ("nobody", "unknown controller")):
        with pytest.raises(CzError, match=said):
            make_base(name, SMALL.config)
    for limits in ((-0.1, 1.0), (0.1, 11.0)):
        with pytest.raises(CzError, match="limits must be a share of v_0"):
            Residual(other, *limits)


@pytest.mark.parametrize(
    ("limits", "said"),
    [("0.1,99", "limits must be a share of v_0 from 0 to 1 and from 0 to 10 kW, not 0.1 and 99 kW"),
     ("0.1", "limits must be numbers with commas between, as (0.1, 1.0)")],
)  # fmt: skip
def test_wrong_limits_are_refused_before_references_are_measured(limits, said, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(train, "_measure_references", None)
    words = ["--algo", "pid-with-learning", "--set", f"limits={limits}", "--out", str(tmp_path / "run")]
    assert train.main(words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("few_crystals")
def test_one_s_own_controller_learns_and_stands_in_the_benchmark(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(MINE.replace("WIDTH", "12"))
    words = "--algo pid-with-learning --steps 8192 --set controller=mine.py:Mine --set limits=0.05,0.5 --out run"
    assert train.main([*words.split(), "--set", "num_envs=64"]) == 0
    run = "--episodes 2 --scenarios randomized --controllers pid-conventional --agent run/agent.onnx --json of.json"
    assert benchmark.main(run.split()) == 2
    assert "name its file too" in capsys.readouterr().err
    assert benchmark.main([*run.split(), "--controller", "mine.py:Mine"]) == 0
    assert "pid-with-learning" in Path("of.json").read_text()
    Path("mine.py").write_text(MINE.replace("WIDTH", "12").replace("0.02", "0.03"))
    assert benchmark.main([*run.split(), "--controller", "mine.py:Mine", "--overwrite"]) == 2
    assert "trained on the controller mine.py:Mine" in capsys.readouterr().err
