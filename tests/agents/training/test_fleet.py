"""``train.py --seeds``: seeds side by side come out as one by one, and nothing is lost or done twice."""

import io
import json
from dataclasses import replace

import pytest
from tqdm import tqdm

from cz_gym.agents import AgentFileError, validation
from cz_gym.agents import train as fleet
from cz_gym.agents import train as run
from cz_gym.agents.recipes import RECIPES
from cz_gym.tools import train
from tests.small_learners import QUICK, REFERENCES, train_small_seed

pytestmark = pytest.mark.usefixtures("few_crystals")
SMALL_PPO = replace(QUICK, steps=4096, control_interval=30.0)


def in_turn(function, tasks, look, *cluster):
    for number, task in enumerate(tasks):
        yield number, function(task)
        look()


@pytest.fixture
def trained(monkeypatch):
    """Small runs in this process; the seeds that were trained, in turn."""
    seeds = []

    def counted(job, bar=None):
        seeds.append(job.seed)
        return train_small_seed(job, bar)

    monkeypatch.setattr(fleet, "train_seed", counted)
    monkeypatch.setattr(fleet, "side_by_side", in_turn)
    monkeypatch.setattr(validation, "references", lambda *_: REFERENCES)
    monkeypatch.setitem(RECIPES, "ppo", SMALL_PPO)
    return seeds


def agents(folder):
    return {path.parent.name: path.read_bytes() for path in sorted(folder.glob("*/agent.onnx"))}


def sessions(folder):
    """How often each seed's run was begun or resumed."""
    every = (json.loads(path.read_text()) for path in sorted(folder.glob("*/settings.json")))
    return [len(each["sessions"]) for each in every]


def test_seeds_come_out_as_one_by_one_and_only_once(trained, tmp_path, capsys):
    several, one = tmp_path / "several", tmp_path / "one"
    assert train.main(["--algo", "ppo", "--seeds", "3-4", "--out", str(several)]) == 0
    assert "seed 4: best agent on 2 validation episodes" in capsys.readouterr().out
    assert train.main(["--algo", "ppo", "--seed", "4", "--out", str(one)]) == 0
    found = agents(several)
    assert list(found) == ["seed3", "seed4"]
    assert found["seed4"] == (one / "agent.onnx").read_bytes() != found["seed3"]
    assert train.main(["--resume", "--seeds", "2-4", "--out", str(several)]) == 0, "the folder knows the recipe"
    assert trained == [3, 4, 4, 2]
    assert sessions(several) == [1, 1, 1]
    assert train.main(["--seeds", "4-5", "--out", str(several)]) == 2
    assert "seed4 holds a run already" in capsys.readouterr().err
    assert train.main(["--resume", "--seeds", "4-5", "--scenario", "hard", "--out", str(several)]) == 2
    assert "begun with another settings" in capsys.readouterr().err


def test_an_unfinished_seed_goes_on_and_longer_runs_do_too(trained, tmp_path, monkeypatch):
    finish = run.Run.finish

    def killed(self):
        if self.seed == 1:
            raise AgentFileError("killed")
        return finish(self)

    command = ["--algo", "ppo", "--seeds", "0-1", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(run.Run, "finish", killed)
        assert train.main(command) == 2
    assert not (tmp_path / "seed1" / "summary.json").exists()
    assert train.main([*command, "--resume"]) == 0
    assert trained == [0, 1, 1]
    assert sessions(tmp_path) == [1, 2]
    assert json.loads((tmp_path / "seed1" / "settings.json").read_text())["sessions"][1]["from_step"] == 4096
    assert train.main([*command, "--resume", "--steps", "6144"]) == 0
    assert trained == [0, 1, 1, 0, 1]


@pytest.mark.parametrize("error", [AgentFileError("the training went wrong"), ValueError("could not be broadcast")])
def test_one_seed_that_fails_stops_no_other(error, tmp_path, monkeypatch, trained, capsys):
    """An error that the project raises on purpose is one line; any other one is raised with its traceback."""

    def failing(job):
        if job.seed == 1:
            raise error
        return train_small_seed(job)

    monkeypatch.setattr(fleet, "train_seed", failing)
    command = ["--algo", "ppo", "--seeds", "0-2", "--out", str(tmp_path)]
    if isinstance(error, AgentFileError):
        assert train.main(command) == 2
        assert capsys.readouterr().err.splitlines()[-1] == "cz-gym train: seed 1: the training went wrong"
    else:
        with pytest.raises(ValueError, match="could not be broadcast") as caught:
            train.main(command)
        notes = "".join(caught.value.__notes__)
        assert "in failing" in notes
        assert "seed 1" in notes
    assert sorted(agents(tmp_path)) == ["seed0", "seed2"]


@pytest.mark.slow
def test_processes_train_the_same(tmp_path, monkeypatch):
    """And the bar counts them all."""
    monkeypatch.setattr(fleet, "train_seed", train_small_seed)
    for place in (tmp_path / "there", tmp_path / "here"):
        jobs = [run.Job(place / f"seed{seed}", SMALL_PPO, seed, REFERENCES) for seed in range(3)]
        with tqdm(total=3, file=io.StringIO()) as bar:
            assert {job.seed for job, _ in fleet.train_seeds(jobs, bar)} == {0, 1, 2}
            assert bar.n == pytest.approx(3)
        monkeypatch.setattr(fleet, "side_by_side", in_turn)
    assert agents(tmp_path / "there") == agents(tmp_path / "here")
