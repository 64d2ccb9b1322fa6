"""Shipped agents by name, and agent files: what is broken, or made for something else, is refused in one line."""

import json
import os

import numpy as np
import onnx
import pytest

from cz_gym import agents
from cz_gym.agents import AgentFileError, OnnxPolicy
from cz_gym.agents.contract import MAX_BYTES, make_contract, read_agent, write_agent
from cz_gym.agents.from_sb3 import to_onnx
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.spaces import HISTORY
from tests.contracts import facts

SHIPPED = {"gradient": 5, "gradient-along": 5, "ppo": 3, "ppo-plain": 3, "sac": 3}
"""Training seeds of each name."""


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_agent_is_called_by_how_it_was_made(name):
    contracts = [read_agent(path)[0] for path in agents.shipped_seeds(name)]
    assert [contract.training_seed for contract in contracts] == list(range(SHIPPED[name]))
    assert {contract.algorithm for contract in contracts} == {name}
    assert all(contract.training_steps > 0 for contract in contracts)
    policy = agents.load(name)
    assert policy.contract.validation_cost == min(contract.validation_cost for contract in contracts)
    assert policy.predict(np.zeros((3, policy.contract.channels), np.float32))[0].shape == (3, 2)


def test_an_agent_is_loaded_by_its_file():
    path = agents.shipped_seeds("ppo")[1]
    assert agents.load(path) == agents.load(str(path)) == agents.OnnxPolicy.load(path)
    assert agents.load("ppo", make_config("hard", **PPO)).settings == PPO


PPO = agents.load("ppo").settings
OTHER = {"action": "smooth", "control_interval": 2.0, "observation": "measured"}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: agents.load("gradeint"), r"unknown shipped agent 'gradeint': did you mean 'gradient'\? Choose from "),
        (lambda: agents.load(""), "unknown shipped agent ''; choose from"),
        (lambda: agents.load("nobody.onnx"), "nobody.onnx: no such file"),
        (lambda: OnnxPolicy.load("ppo"), r"not an \.onnx agent file; cz_gym\.agents\.load\('ppo'\) loads"),
        *(
            (lambda to=to: agents.load("ppo", make_config(**PPO | to)), f"made for {name}=.*, this config has {of!r}")
            for name, of in OTHER.items()
            for to in [{name: of}]
        ),
        (
            lambda: agents.load("ppo", make_config(process=CRYSTAL, **PPO)),
            "trained for Cz-v0, not for CzCrystal-v0: gym.make",
        ),
    ],
)
def test_an_agent_that_does_not_exist_or_was_made_for_something_else_is_refused_in_one_line(call, message):
    with pytest.raises(AgentFileError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.fixture
def agent(ppo, tmp_path):
    path = tmp_path / "agent.onnx"
    write_agent(path, to_onnx(ppo.policy, len(HISTORY)), **facts())
    return path


def test_one_observation_and_a_batch_of_one_act_alike(agent):
    policy = OnnxPolicy.load(agent)
    seen = np.random.default_rng(0).uniform(-3.0, 3.0, (1, len(HISTORY))).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(seen)[0][0], policy.predict(seen[0])[0])
    with pytest.raises(ValueError, match="expected 73 channels"):
        policy.predict(seen[:, :-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation": "camera"}, "does not have"),
        ({"channels": 72}, "reads 72 channels"),
        ({"channels": "73"}, "must be int"),
        ({"format": "zip"}, "not a cz-gym-agent contract"),
        ({"format_version": 1}, "format version 1, this release reads 6"),
        ({"sha256": "0" * 64}, "SHA-256 differs"),
        ({"surprise": 1}, "'surprise' is unknown"),
        ({"algorithm": "mine | yours"}, r"must be printable text of 1 to 160 characters without \|"),
        ({"validation_rmse_mm": float("nan")}, "must be finite"),
        ({"validation_rmse_mm": float("inf")}, "must be finite"),
        ({"validation_rmse_mm": -1.0}, "at least 0"),
    ],
)
def test_broken_promises_are_refused(agent, change, message):
    contract = agent.with_suffix(".json")
    contract.write_text(json.dumps({**json.loads(contract.read_text()), **change}))
    with pytest.raises(AgentFileError, match=message) as caught:
        OnnxPolicy.load(agent)
    assert "\n" not in str(caught.value)


def last_bias(model, value):
    (weight,) = (each for each in model.graph.initializer if each.name == model.graph.node[-2].input[2])
    weight.CopyFrom(onnx.numpy_helper.from_array(value, weight.name))


def infinity_less_infinity(model):
    last_bias(model, np.full(2, 3e38, np.float32))
    (beta,) = (each for each in model.graph.node[-2].attribute if each.name == "beta")
    beta.f = 2.0
    clip = model.graph.node[-1]
    clip.CopyFrom(onnx.helper.make_node("Sub", [clip.input[0], clip.input[0]], [clip.output[0]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda model: last_bias(model, np.full(2, np.nan, np.float32)), "not finite"),
        (infinity_less_infinity, "not two finite numbers"),
        (lambda model: last_bias(model, np.zeros(900, np.float32)), "cannot be run"),
    ],
)
def test_networks_that_give_no_action_are_refused(change, message, agent):
    model = onnx.load_from_string(agent.read_bytes())
    change(model)
    content = model.SerializeToString()
    with pytest.raises(AgentFileError, match=message):
        OnnxPolicy.of(make_contract(content, **facts()), content)


def test_an_agent_loads_where_the_system_has_no_pipes_to_wait_for(agent, monkeypatch):
    """Windows has no O_NONBLOCK, and a flag of its own without which a file would end at a Ctrl-Z."""
    binary, opened, by_system = 1 << 28, [], os.open

    def opening(path, flags, *rest, **named):
        opened.append((str(path), flags & binary))
        return by_system(path, flags & ~binary, *rest, **named)

    monkeypatch.delattr(os, "O_NONBLOCK")
    monkeypatch.setattr(os, "O_BINARY", binary, raising=False)
    monkeypatch.setattr(os, "open", opening)
    OnnxPolicy.load(agent)
    assert (str(agent), binary) in opened


def test_an_oversized_file_is_refused(agent):
    agent.write_bytes(b"0" * (MAX_BYTES + 1))
    with pytest.raises(AgentFileError, match="larger than"):
        OnnxPolicy.load(agent)
