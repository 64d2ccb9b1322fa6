"""``train.py``: a run leaves what it promises, goes on where it stopped, and answers mistakes in one line."""

from __future__ import annotations

import csv
import errno
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import train
from cz_gym import CzVectorEnv
from cz_gym.agents import OnnxPolicy
from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training import run, run_files
from cz_gym.agents.training.vec_env import CzVecEnv
from cz_gym.agents.training.wrappers import DriveAction, TrainingReward
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

ROOT = Path(__file__).parents[3]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(run, "JUDGING", VALIDATION_SEEDS[2:4])
    recipe = replace(
        settings.RECIPES["ppo"].recipe, num_envs=64, clone=settings.Clone("lqg", rounds=2, episodes=2, epochs=1)
    )
    monkeypatch.setitem(
        settings.RECIPES, "ppo", replace(settings.PPO(), recipe=recipe, n_steps=32, batch_size=1024, critic_steps=4096)
    )


def rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.mark.usefixtures("quick")
def test_a_run_leaves_everything_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    assert train.main(["--steps", "20000", "--seed", "3", "--out", str(folder)]) == 0
    saved = json.loads((folder / "settings.json").read_text())
    assert saved["seed"] == 3
    assert saved["settings"]["recipe"]["scenario"] == "randomized"
    assert saved["packages"]["stable-baselines3"]
    assert {"command", "git_commit", "plant_hash", "scenario_hash"} <= set(saved)
    policy = OnnxPolicy.load(folder / "agent.onnx")
    assert policy.contract.training_seed == 3
    summary, picked = json.loads((folder / "summary.json").read_text()), rows(folder / "progress.csv")
    assert policy.contract.validation_cost == summary["validation_cost"]
    assert policy.contract.validation_rmse_mm == summary["validation_rmse_mm"]
    assert summary["validation_cost"] not in {float(row["validation_cost"]) for row in picked}, (
        "judged as it was picked"
    )
    assert list((folder / "tensorboard").rglob("events.*"))
    before = rows(folder / "progress.csv")
    assert float(before[-1]["paper_rmse_mm"]) > 0
    assert train.main(["--seed", "3", "--resume", "--out", str(folder)]) == 0, "nothing was left to learn"
    assert rows(folder / "progress.csv")[:-1] == before
    assert train.main(["--out", str(folder)]) == 2
    assert "--resume" in capsys.readouterr().err
    assert train.main(["--steps", "40000", "--seed", "3", "--resume", "--out", str(folder)]) == 0
    after = rows(folder / "progress.csv")
    assert after[: len(before)] == before
    assert int(after[-1]["steps"]) >= 40000 > int(before[-1]["steps"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("train.py", "train.py"),
        (str(ROOT / "train.py"), "train.py"),
        (str(ROOT / "studies" / "ablation" / "__main__.py"), "-m studies.ablation"),
        ("/elsewhere/bin/pytest", "pytest"),
    ],
)
def test_the_command_is_told_without_the_machine_s_paths(
    given: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [given, "--seed", "3"])
    assert run_files.provenance()["command"].endswith(f" {said} --seed 3")


@pytest.mark.usefixtures("quick")
def test_an_interrupted_run_keeps_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(self: Any, bar: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run.Run, "_validate", interrupt)
    folder = tmp_path / "run"
    assert train.main(["--steps", "10000", "--out", str(folder)]) == 130
    assert (folder / "checkpoint.safetensors").exists()
    assert "--resume" in capsys.readouterr().err


@pytest.mark.usefixtures("quick")
def test_a_run_killed_at_once_can_be_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(self: Any, bar: Any) -> None:
        raise ValueError("killed")

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(run.Run, "learn", die)
        assert train.main(["--steps", "10000", "--out", str(folder)]) == 2
    assert train.main(["--resume", "--out", str(folder)]) == 0
    saved = json.loads((folder / "settings.json").read_text())
    assert [session["from_step"] for session in saved["sessions"]] == [0, 0]


@pytest.mark.usefixtures("quick")
def test_a_run_killed_between_imitation_and_first_step_does_not_imitate_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*arguments: Any) -> None:
        raise ValueError("killed")

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(run.Tell, "_on_step", die)
        assert train.main(["--steps", "2048", "--out", str(folder)]) == 2
    imitated = rows(folder / "progress.csv")
    assert [row["steps"] for row in imitated] == ["0"]
    monkeypatch.setattr(run, "clone", die)
    assert train.main(["--resume", "--out", str(folder)]) == 0
    assert rows(folder / "progress.csv")[:1] == imitated


def test_settings_that_are_none_are_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "settings.json").write_text("[]")
    assert train.main(["--resume", "--steps", "10", "--out", str(folder)]) == 2
    assert "missing or damaged" in capsys.readouterr().err


def test_interrupting_before_learning_gives_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(arguments: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "train", interrupt)
    assert train.main(["--out", str(tmp_path / "run")]) == 130
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo", "dqn"], "invalid choice: 'dqn'"),
        (["--steps", "0"], "at least 1, not '0'"),
        (["--seed", "minus"], "at least 0, not 'minus'"),
        (["--checkpoint-seconds", "-1"], "at least 0, not '-1'"),
        (["--checkpoint-seconds", "nan"], "at least 0, not 'nan'"),
        (["--sceanrio", "hard"], "unrecognized arguments"),
        (["--scen", "hard"], "unrecognized arguments"),
    ],
)
def test_impossible_arguments_exit_with_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        train.main(arguments)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "quiet"], "unknown scenario 'quiet'"),
        (["--resume"], "nothing to resume"),
    ],
)
def test_mistakes_give_one_line(
    tmp_path: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train.main([*arguments, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("quick")
def test_a_full_disk_is_one_line_that_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("cz_gym.atomic_files.os.fsync", full)
    folder = tmp_path / "run"
    assert train.main(["--steps", "10000", "--out", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error == f"train.py: {folder / run.CHECKPOINT}: No space left on device\n"
    assert not list(folder.glob("*.*"))


@pytest.mark.parametrize(
    "settings", ["[" * 100_000, '{"steps": true, "sessions": [{}]}', '{"steps": 9, "sessions": 3}', "x" * 2_000_000]
)
def test_settings_from_a_stranger_are_refused_in_one_line(
    tmp_path: Path, settings: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "settings.json").write_text(settings)
    assert train.main(["--resume", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "missing or damaged" in error
    assert error.count("\n") == 1


def slots(**settings: Any) -> CzVecEnv:
    return CzVecEnv(CzVectorEnv(2, observation="history", autoreset_mode="SameStep", **settings))


def test_training_reward_makes_a_failure_cost_the_worst_for_ever() -> None:
    env = TrainingReward(slots(), gamma=0.9)
    env.seed(0)
    env.reset()
    worst = 0.0
    for _ in range(2000):
        _, reward, done, infos = env.step(np.array([[1.0, 1.0], [0.0, 0.0]], np.float32))
        if done[0]:
            assert not infos[0]["TimeLimit.truncated"]
            worst = float(reward[0])
            break
    assert worst == pytest.approx(-10.0)


def test_drive_action_moves_the_drives_from_where_they_are() -> None:
    plain, driven = slots(), DriveAction(slots(), 1.0, (0.1, 0.2))
    for env in (plain, driven):
        env.seed(5)
        env.reset()
    position = np.zeros(2)
    for move in ([1.0, -0.5], [0.5, 1.0], [-1.0, 0.0]):
        position = position + np.array([0.1, 0.2]) * move
        expected = plain.step(np.tile(position, (2, 1)).astype(np.float32))
        got = driven.step(np.tile(move, (2, 1)).astype(np.float32))
        np.testing.assert_allclose(got[0], expected[0], atol=1e-6)
