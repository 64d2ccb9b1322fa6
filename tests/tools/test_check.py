"""``cz-gym check``: what fits is described, what does not is refused in one line with the reason."""

import re

import pytest

from cz_gym import agents
from cz_gym.tools.check import main

OWN = """
import numpy as np
from cz_gym.baselines import CompensatedPID as Good

class Base:
    settings = {"observation": "history", "action": "smooth"}

    def act(self, observation, state, begins):
        return np.zeros((len(observation), 2), np.float32), state

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self.act(observation, state, episode_start)

class Single(Base):
    def act(self, observation, state, begins):
        return np.zeros(2, np.float32), state

class NotANumber(Base):
    def act(self, observation, state, begins):
        return np.full((len(observation), 2), np.nan), state

class Batch(Base):
    def act(self, observation, state, begins):
        return np.tile(observation.mean(axis=0)[:2], (len(observation), 1)), state

class Remembers(Base):
    def act(self, observation, state, begins):
        state = np.zeros((len(observation), 2)) if state is None else state + 0.001
        return state, state

class Writes(Base):
    def act(self, observation, state, begins):
        observation[:] = 0.0
        return np.zeros((len(observation), 2)), state

class Signature(Base):
    def predict(self, observation):
        return np.zeros(2)

class Slow(Base):
    settings = {"observation": "history", "control_interval": 10.0}
"""


def test_an_agent_that_fits_is_described(capsys):
    assert main([str(agents.shipped("gradient"))]) == 0
    told = capsys.readouterr().out
    for line in (
        r"environment +Cz-v0, puller default, plant \w{16}", r"observation +measured", r"action +rate",
        r"interval +5 s", r"declared +\d{2,3},\d{3},\d{3} steps, seed \d, learned, plant known in training",
        r"shapes +\(12,\) to \(2,\)", r"state +\d+ bytes a crystal", r"memory +[\d.]+ MB", r"speed +\d+ us a step",
    ):  # fmt: skip
        assert re.search(rf"^{line}", told, re.MULTILINE), line
    assert told.endswith("fits: it may run in the benchmark\n")


@pytest.fixture
def own(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return lambda name: [f"{tmp_path / 'own.py'}:{name}"]


def test_a_controller_that_fits_is_described(own, capsys):
    assert main(own("Good")) == 0
    assert re.search(r"^observation +measured\naction +direct$", capsys.readouterr().out, re.MULTILINE)
    assert main(own("Base")) == 0
    assert re.search(r"^observation +history\naction +smooth$", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Single", "predict must return actions of shape (16, 2) for 16 observations, not (2,)"),
        ("NotANumber", "step 0: its actions are not finite numbers"),
        ("Batch", "its action depends on the batch"),
        ("Remembers", "its memory does not begin anew where episode_start is true"),
        ("Writes", "step 0: it writes into the observations"),
        ("Signature", "it must be predict(observation, state=None"),
        ("Slow", "control_interval=10"),
        ("Nobody", "unknown controller 'Nobody'"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(own, name, says, refused):
    assert says in refused(main, own(name))


def test_agents_of_other_plants_and_broken_files_are_refused(tmp_path, refused, capsys):
    file = str(agents.shipped("ppo"))
    assert main([file, "--puller", "germanium"]) == 2
    assert "trained for puller default, this environment's is germanium" in capsys.readouterr().err
    assert "no such file" in refused(main, [str(tmp_path / "a.onnx")])
    assert "must be an agent file (.onnx) or FILE.py:NAME" in refused(main, ["ppo"])
