"""Cz-v0 under other people's training code: RL-Zoo's files, with stable-baselines3's own vector."""

import inspect
from pathlib import Path

import pytest
import yaml
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

import cz_gym  # noqa: F401  (registers Cz-v0)

FOLDER = Path(__file__).parents[2] / "examples" / "rl_zoo"
ALGORITHMS = {"ppo": PPO, "ppo_lstm": RecurrentPPO, "sac": SAC, "tqc": TQC}
TAKEN_BY_RL_ZOO = ("env_kwargs", "normalize", "n_envs", "n_timesteps")
SMALL = {
    "ppo": {"n_steps": 8, "batch_size": 16, "n_epochs": 1},
    "ppo_lstm": {"n_steps": 8, "batch_size": 16, "n_epochs": 1},
    "sac": {"learning_starts": 8, "buffer_size": 64, "batch_size": 8},
    "tqc": {"learning_starts": 8, "buffer_size": 64, "batch_size": 8},
}


def read(name):
    """Hyperparameters as RL-Zoo reads them: schedules "lin_x", and dictionaries written as Python."""
    found = yaml.safe_load((FOLDER / f"{name}.yml").read_text())
    assert list(found) == ["Cz-v0"]
    chosen = found["Cz-v0"]
    for key, value in chosen.items():
        if isinstance(value, str) and value.startswith("lin_"):
            chosen[key] = float(value.removeprefix("lin_"))
        elif isinstance(value, str) and value[0] in "{d":
            chosen[key] = eval(value, {"dict": dict})
    return chosen


@pytest.mark.parametrize("name", ALGORITHMS)
def test_rl_zoos_files_are_what_their_algorithms_take(name):
    chosen = read(name)
    rest = {key: value for key, value in chosen.items() if key not in TAKEN_BY_RL_ZOO}
    assert set(rest) <= set(inspect.signature(ALGORITHMS[name]).parameters)
    assert set(chosen["normalize"]) == {"norm_obs", "norm_reward"}
    env = make_vec_env("Cz-v0", n_envs=2, env_kwargs=chosen.get("env_kwargs"))
    ALGORITHMS[name](env=env, device="cpu", **{**rest, **SMALL[name]}).learn(24)


def test_every_file_says_its_command():
    assert {path.stem for path in FOLDER.glob("*.yml")} == set(ALGORITHMS)
    for path in FOLDER.glob("*.yml"):
        command = f"python -m rl_zoo3.train --algo {path.stem} --env Cz-v0 --gym-packages cz_gym"
        text = path.read_text()
        assert f"{command} --conf-file examples/rl_zoo/{path.name}" in text
        # RL-Zoo 2.9 evaluates on an environment without the file's env_kwargs.
        for key, value in read(path.stem).get("env_kwargs", {}).items():
            assert f"--env-kwargs \"{key}:'{value}'\"" in text
