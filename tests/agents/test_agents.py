"""Shipped agents by name."""

import numpy as np
import pytest

from cz_gym import agents
from cz_gym.agents.contract import read_agent
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL

SHIPPED = {"gradient": 10, "gradient-along": 5, "ppo": 5, "ppo-along": 5, "ppo-plain": 3, "sac": 5}
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


@pytest.mark.parametrize(
    ("load", "name", "message"),
    [
        (agents.load, "gradeint", r"unknown shipped agent 'gradeint': did you mean 'gradient'\? Choose from "),
        (agents.load, "", "unknown shipped agent ''; choose from"),
        (agents.load, "nobody.onnx", "nobody.onnx: no such file"),
        (agents.OnnxPolicy.load, "ppo", r"not an \.onnx agent file; cz_gym\.agents\.load\('ppo'\) loads"),
    ],
)
def test_an_agent_that_does_not_exist_is_refused_in_one_line(load, name, message):
    with pytest.raises(agents.AgentFileError, match=message) as caught:
        load(name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("other", [{"action": "rate"}, {"control_interval": 2.0}, {"observation": "measured"}])
def test_an_agent_refuses_a_config_that_it_is_not_made_for(other):
    settings = agents.load("ppo").settings
    assert agents.load("ppo", make_config("hard", **settings)).settings == settings
    ((name, value),) = other.items()
    with pytest.raises(agents.AgentFileError, match=f"ppo is made for {name}=.*, this config has {value!r}"):
        agents.load("ppo", make_config(**{**settings, **other}))


def test_an_agent_of_one_environment_is_refused_by_the_other():
    with pytest.raises(agents.AgentFileError, match=r"ppo-seed.\.onnx: trained for Cz-v0, not for CzCrystal-v0$"):
        agents.load("ppo", make_config(process=CRYSTAL, **agents.load("ppo").settings))
