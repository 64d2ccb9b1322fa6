"""The examples that users copy: each learns, is judged, and writes the files that it names."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from cz_gym import agents
from examples import gradient, sb3_ppo


@pytest.mark.usefixtures("few_crystals")
def test_the_stable_baselines_example_writes_an_agent(tmp_path):
    contract = sb3_ppo.main(steps=40_000, out=tmp_path / "some.onnx")
    assert (contract.action, contract.algorithm, contract.training_steps) == ("smooth", "sb3-ppo", 262_144)
    assert agents.load(tmp_path / "some.onnx").contract == contract


@pytest.mark.usefixtures("few_crystals")
def test_the_gradient_example_writes_an_agent(tmp_path):
    contract = gradient.main(steps=1440, num_envs=8, out=tmp_path / "some.onnx")
    assert (contract.action, contract.observation, contract.training_steps) == ("rate", "measured", 1440)
    assert "0.175 hot-zone" in contract.scenario
    assert agents.load(tmp_path / "some.onnx").contract == contract


def test_an_example_without_its_packages_says_in_one_line_what_to_install():
    command = [sys.executable, "-S", "-m", "examples.gradient"]  # -S: nothing but Python's own modules
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(r"\w+ is missing: .*pip install .*\n", done.stderr)
