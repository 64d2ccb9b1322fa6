"""The examples that users copy: each learns, is judged, and writes the files it names; RL-Zoo's files."""

import inspect
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

from cz_gym import CzVectorEnv, agents
from cz_gym.agents import OnnxPolicy, recipes
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Actuators
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import user_controller
from cz_gym.evaluation.rollout import rollout
from cz_gym.examples import anywhere, gradient, ppo_lagrangian, sb3_ppo
from cz_gym.sb3 import CzVecEnv
from cz_gym.support.units import KILO, MINUTE, MM_PER_MIN
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN

SEEDS = range(1_000_000, 1_000_002)
MPC = "examples/mpc.py:mpc"


@pytest.mark.slow
@pytest.mark.usefixtures("few_crystals")
def test_the_stable_baselines_example_writes_an_agent(tmp_path):
    contract = sb3_ppo.main(steps=40_000, out=tmp_path / "some.onnx")
    assert (contract.action, contract.algorithm, contract.training_steps) == ("smooth", "sb3-ppo", 262_144)
    assert agents.load(tmp_path / "some.onnx").contract == contract


@pytest.mark.filterwarnings("ignore:.*found in sys.modules")
@pytest.mark.parametrize("name", ["sb3_ppo", "ppo_lagrangian"])
@pytest.mark.parametrize(("words", "code"), [(["--help"], 0), (["first"], 2)])
def test_a_training_of_one_page_says_what_it_takes(name, words, code, monkeypatch):
    monkeypatch.setattr(sys, "argv", [name, *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"cz_gym.examples.{name}", run_name="__main__")
    assert ended.value.code == code


@pytest.mark.usefixtures("few_crystals")
def test_the_gradient_example_writes_an_agent(tmp_path):
    contract = gradient.main(steps=1440, num_envs=8, out=tmp_path / "some.onnx")
    assert (contract.action, contract.observation, contract.training_steps) == ("rate", "measured", 1440)
    assert "0.175 hot-zone" in contract.scenario
    assert agents.load(tmp_path / "some.onnx").contract == contract


@pytest.mark.usefixtures("few_crystals")
def test_the_price_of_steps_out_of_tolerance_rises_above_the_limit_and_the_reward_pays_it(tmp_path, monkeypatch):
    """Random actions are out of tolerance most of the time, and no crystal is always."""
    monkeypatch.setattr(ppo_lagrangian, "LIMIT", 0.0)
    contract, multiplier = ppo_lagrangian.main(steps=8 * 4 * 64 * 3, num_envs=8, out=tmp_path / "some.onnx")
    assert (contract.algorithm, contract.training_steps) == ("ppo-lagrangian", 6144)
    assert 0.0 < multiplier <= 3 * ppo_lagrangian.RATE

    priced = ppo_lagrangian.Priced(CzVecEnv(CzVectorEnv(2, "nominal", autoreset_mode="SameStep")))
    priced.reset()
    priced.multiplier = 7.0
    faster = np.float32([[0.2, 0.0], [0.0, 0.0]])
    charged = [priced.step(faster)[1] for _ in range(90)]
    assert priced.crystals.cost.tolist() == [1.0, 0.0]
    assert charged[-1][0] < charged[-1][1] - 7.0


def test_an_example_without_its_packages_says_in_one_line_what_to_install():
    command = [sys.executable, "-S", "-m", "examples.gradient"]  # -S: nothing but Python's own modules
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(r"\w+ is missing: .*pip install .*\n", done.stderr)


@pytest.mark.slow
def test_the_predictive_controller_holds_a_crystal_as_lqg_does():
    config = make_config(horizon=600.0, **PLAIN)
    own, lqg = (
        rollout(policy, config, SEEDS) for policy in (user_controller(MPC).make(config), make_controller("lqg", config))
    )
    assert not own.failed.any()
    np.testing.assert_allclose(metrics(own).rmse_mm, metrics(lqg).rmse_mm, rtol=0.05)


def test_the_predictive_controller_asks_for_nothing_beyond_the_limits_of_the_drives():
    actuators = Actuators(
        pull_window=0.02 * MM_PER_MIN, pull_slew=0.05 * MM_PER_MIN / MINUTE, heater_slew=0.5 * KILO / MINUTE
    )
    config = make_config(replace(RANDOMIZED, name="narrow", actuators=actuators), horizon=300.0, **PLAIN)
    with pytest.warns(UserWarning, match=r"lqg was not tuned for actuators\.pull_window"):
        run = rollout(user_controller(MPC).make(config), config, SEEDS)
    pull = run.signals.v_p - config.parameters.v_0
    assert not run.failed.any()
    assert np.abs(pull).max() == pytest.approx(actuators.pull_window, rel=1e-3)


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


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize(
    "manner", [pytest.param(each, marks=[pytest.mark.slow] * (each == "torchrl")) for each in anywhere.LOOPS]
)
def test_a_loop_in_the_manner_of_each_library_ends_in_an_agent_file(manner, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recipes, "JUDGING_SEEDS", recipes.JUDGING_SEEDS[:2])
    file = tmp_path / "agent.onnx"
    command = [manner, "--minutes", "0.01", "--crystals", "64", "--seed", "3", "--out", str(file)]
    assert anywhere.main(command) == 0
    contract = OnnxPolicy.load(file).contract
    assert (contract.training_seed, contract.observation, contract.learned_from) == (3, "history", "reward")
    assert f"{contract.training_steps:,} steps" in capsys.readouterr().out
