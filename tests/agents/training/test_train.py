"""``train.py``: a run leaves what it promises, goes on where it stopped, and answers mistakes in one line."""

import csv
import itertools
import json
import os
import signal
import sys
from dataclasses import replace

import pytest
import torch

from cz_gym.agents import AgentFileError, OnnxPolicy, load
from cz_gym.agents import train as run
from cz_gym.agents.recipes import CRYSTAL_RECIPES, RECIPES
from cz_gym.agents.train import load_checkpoint
from cz_gym.config import make_config
from cz_gym.support.command_line import interpreter
from cz_gym.tools import train
from tests.small_learners import QUICK

ALONG = {name: getattr(CRYSTAL_RECIPES["ppo"], name) for name in ("environment", "stages", "scenario")}


@pytest.fixture
def quick(monkeypatch, few_crystals):
    monkeypatch.setitem(RECIPES, "ppo", QUICK)
    monkeypatch.setitem(CRYSTAL_RECIPES, "ppo", replace(QUICK, name="ppo-along", **ALONG))
    for recipes in (RECIPES, CRYSTAL_RECIPES):
        monkeypatch.setitem(recipes, "gradient", replace(recipes["gradient"], num_envs=64, window=12))


def rows(path):
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("algorithm", [pytest.param("gradient", marks=pytest.mark.slow), "ppo"])
def test_a_run_leaves_everything_and_goes_on(algorithm, tmp_path, capsys):
    folder = tmp_path / "run"
    assert train.main(["--algo", algorithm, "--steps", "9000", "--seed", "3", "--out", str(folder), "--plot"]) == 0
    crystals = "0.175 hard + 0.175 hot-zone + 0.175 puller + 0.3 randomized + 0.175 sensor-fault"
    assert f" steps on {crystals}, into {folder}\n" in capsys.readouterr().out
    assert (folder / "progress.png").read_bytes().startswith(b"\x89PNG")
    saved = json.loads((folder / "settings.json").read_text())
    assert saved["seed"] == 3
    assert saved["settings"]["scenario"] == RECIPES[algorithm].scenario
    assert saved["packages"]["stable-baselines3"]
    assert {"command", "git_commit", "plant_hash", "scenario_hash"} <= set(saved)
    policy = OnnxPolicy.load(folder / "agent.onnx")
    assert policy.contract.training_seed == 3
    summary, picked = json.loads((folder / "summary.json").read_text()), rows(folder / "progress.csv")
    assert policy.contract.validation_cost == summary["validation_cost"]
    assert policy.contract.validation_rmse_mm == summary["validation_rmse_mm"]
    picked_by = {float(row["validation_rmse_mm"]) for row in picked}
    assert summary["validation_rmse_mm"] not in picked_by, "judged as it was picked"
    assert list((folder / "tensorboard").rglob("events.*"))
    before = rows(folder / "progress.csv")
    assert float(before[-1]["paper_rmse_mm"]) > float(before[-1]["lqg_rmse_mm"]) > 0
    assert train.main(["--resume", "--out", str(folder)]) == 0, "nothing was left to learn"
    assert rows(folder / "progress.csv") == before
    assert train.main(["--algo", algorithm, "--out", str(folder)]) == 2
    assert "--resume" in capsys.readouterr().err
    assert train.main(["--algo", algorithm, "--steps", "18000", "--seed", "3", "--resume", "--out", str(folder)]) == 0
    after = rows(folder / "progress.csv")
    assert after[: len(before)] == before
    assert int(after[-1]["steps"]) >= 18000 > int(before[-1]["steps"])


@pytest.fixture
def ctrl_c():
    """Ctrl-C as in a terminal, also where pytest itself runs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("algorithm", CRYSTAL_RECIPES)
def test_a_run_on_whole_crystals_goes_on_and_its_agent_is_for_these(algorithm, tmp_path, capsys):
    folder = tmp_path / "run"
    assert train.main(["--env", "CzCrystal-v0", "--algo", algorithm, "--steps", "6000", "--out", str(folder)]) == 0
    assert "on CzCrystal-v0 (crown, body, tail), 0.5 hard + 0.5 randomized, into" in capsys.readouterr().out
    contract = OnnxPolicy.load(folder / "agent.onnx").contract
    assert (contract.environment, contract.algorithm) == ("CzCrystal-v0", f"{algorithm}-along")
    before = rows(folder / "progress.csv")
    assert list(before[-1])[-2:] == ["compensated_rmse_mm", "lqg-along_rmse_mm"]
    assert train.main(["--resume", "--steps", "12000", "--out", str(folder)]) == 0
    assert rows(folder / "progress.csv")[: len(before)] == before
    with pytest.raises(AgentFileError, match=r"agent.onnx: trained for CzCrystal-v0, not for Cz-v0$"):
        load(folder / "agent.onnx", make_config())
    assert train.main(["--env", "Cz-v0", "--resume", "--out", str(folder)]) == 2
    assert f"'{algorithm}-along' is no recipe here" in capsys.readouterr().err


@pytest.mark.usefixtures("quick", "ctrl_c")
@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
def test_ctrl_c_in_the_middle_of_an_update_saves_after_it(tmp_path, monkeypatch, capsys):
    """An update is four optimiser steps: two batches in each of two epochs, of which the second is interrupted."""
    clip, calls = torch.nn.utils.clip_grad_norm_, itertools.count(1)

    def interrupted(*arguments):
        if next(calls) == 6:
            os.kill(os.getpid(), signal.SIGINT)
        return clip(*arguments)

    monkeypatch.setitem(RECIPES, "ppo", replace(QUICK, n_epochs=2))
    monkeypatch.setattr("torch.nn.utils.clip_grad_norm_", interrupted)
    folder = tmp_path / "run"
    assert train.main(["--steps", "12000", "--out", str(folder)]) == 130
    assert f"{interpreter()} -m cz_gym train --steps 12000 --out {folder} --resume continues" in capsys.readouterr().err
    progress, learned, _ = load_checkpoint(folder / run.CHECKPOINT)
    assert 2 * 4096 < progress.steps < 3 * 4096
    assert float(learned.states["policy.optimizer"]["state"][0]["step"]) == 8.0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "9-0"], "must be FIRST-LAST"),
        (["--seeds", "0-99999999999"], "at most 1000 seeds"),
        (["--steps", "0"], "between 1 and 1000000000000, not 0"),
        (["--checkpoint-seconds", "nan"], "between 0 and 1000000, not nan"),
        (["--sceanrio", "hard"], "unrecognized arguments"),
        (["--scenario", "quiet"], "unknown scenario 'quiet'"),
        (["--scenario", "hard=much"], "'hard=much' is no scenario with its share"),
        (["--scenario", "none.py:quiet"], "none.py: no such file"),
        (["--resume"], "nothing to resume"),
        (["--env", "CzCrystal-v0", "--algo", "sac"], "'sac' is no recipe here: name one of ppo, gradient by --algo"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(tmp_path, arguments, message, refused):
    assert message in refused(train.main, [*arguments, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()
