"""Shipped agents by name."""

import numpy as np
import pytest

from cz_gym import agents
from cz_gym.agents.agent_file.contract import read_agent

SHIPPED = {
    "gradient": 10,
    "gradient-hard": 5,
    "gradient-puller": 5,
    "gradient-randomized": 5,
    "gradient-sensor-fault": 5,
    "imitation": 3,
    "ppo": 3,
    "ppo-recurrent": 3,
    "random-search": 3,
    "sac": 3,
}
"""Training seeds of each name."""


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_agent_is_called_by_how_it_was_made(name: str) -> None:
    contracts = [read_agent(path)[0] for path in agents.shipped_seeds(name)]
    assert [contract.training_seed for contract in contracts] == list(range(SHIPPED[name]))
    assert {contract.algorithm for contract in contracts} == {name}
    assert all((contract.training_steps > 0) == (name != "imitation") for contract in contracts)
    policy = agents.load(name)
    assert policy.contract.validation_cost == min(contract.validation_cost for contract in contracts)
    assert policy.predict(np.zeros((3, policy.contract.channels), np.float32))[0].shape == (3, 2)


def test_nothing_else_is_shipped() -> None:
    assert {path.stem.rpartition("-seed")[0] for path in agents.MODELS.iterdir()} == set(SHIPPED)


def test_an_agent_is_loaded_by_its_file() -> None:
    path = agents.shipped_seeds("ppo")[1]
    assert agents.load(path) == agents.load(str(path)) == agents.OnnxPolicy.load(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("imitatoin", "unknown shipped agent 'imitatoin': did you mean 'imitation'\\? Choose from "),
        ("", "unknown shipped agent ''; choose from"),
        ("nobody.onnx", "nobody.onnx: no such file"),
    ],
)
def test_what_there_is_not_is_one_line(name: str, message: str) -> None:
    with pytest.raises(agents.AgentFileError, match=message) as caught:
        agents.load(name)
    assert "\n" not in str(caught.value)
