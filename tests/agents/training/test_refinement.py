"""PPO that goes on from an agent of the recipe gradient: it begins as that agent, and other files are refused."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import train
from cz_gym import CzVectorEnv, agents
from cz_gym.agents.agent_file.contract import agent_files, read_agent
from cz_gym.agents.training.filter_bank import STATE
from cz_gym.agents.training.recipes import RECIPES
from cz_gym.agents.training.refinement import Remembering
from cz_gym.agents.training.vec_env import CzVecEnv
from cz_gym.atomic_files import write_files
from cz_gym.observation import decode
from tests.small_learners import made

START = agents.shipped_seeds("gradient")[0]
FEW: dict[str, Any] = {"num_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1, "hidden": (4,), "steps": 256}
SMALL: Any = replace(RECIPES["ppo-after-gradient"], start=str(START), **FEW)


def test_it_begins_as_the_agent_that_it_goes_on_from() -> None:
    learner, agent = made(SMALL), agents.load(START)
    assert learner.exported() == START.read_bytes()
    settings: Any = {"action": "rate", "horizon": 3600.0, "autoreset_mode": AutoresetMode.SAME_STEP}
    ours = Remembering(
        CzVecEnv(CzVectorEnv(3, observation="history", **settings), privileged=True), learner.algorithm.policy.bank
    )
    theirs = CzVectorEnv(3, **settings)
    ours.seed(5)
    features, (measured, _) = ours.reset(), theirs.reset(seed=[5, 6, 7])
    memory, begins, ends, moved = None, np.ones(3, bool), 0, np.zeros(2)
    for _ in range(800):
        reading = decode(measured)
        moved = np.maximum(moved, [np.abs(reading.r_ref).max(), np.abs(reading.T_1_ref).max()])
        mean, _ = learner.algorithm.policy.predict(features, deterministic=True)
        action, memory = agent.predict(measured, memory, begins)
        assert mean == pytest.approx(action, abs=1e-5)
        features, _, begins, infos = ours.step(action)
        measured, _, _, _, more = theirs.step(action)
        for i in np.flatnonzero(begins):
            last = learner.algorithm.policy.bank.remember(
                *(torch.from_numpy(np.array(each)) for each in (more["final_obs"][i][None], memory[i : i + 1]))
            )
            assert infos[i]["terminal_observation"][: last[0].shape[1]] == pytest.approx(last[0][0].numpy(), abs=1e-5)
            ends += 1
    assert ends == 3
    assert (moved > [1e-4, 1.0]).all()  # references that move tell "history" from "measured"
    assert memory.shape == (3, STATE)


@pytest.mark.usefixtures("few_crystals")
def test_a_run_goes_on_from_a_file_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(RECIPES, "ppo-after-gradient", replace(RECIPES["ppo-after-gradient"], **FEW))
    folder = str(tmp_path / "run")
    assert train.main(["--algo", "ppo", "--from", str(START), "--out", folder]) == 0
    assert train.main(["--resume", "--steps", "512", "--out", folder]) == 0
    made_so = agents.load(Path(folder) / "agent.onnx").contract
    assert (made_so.algorithm, made_so.observation, made_so.action) == ("ppo-after-gradient", "measured", "rate")
    contract, _ = read_agent(START)
    damaged = tmp_path / "damaged.onnx"
    write_files(agent_files(damaged, b"no graph", replace(contract, sha256=hashlib.sha256(b"no graph").hexdigest())))
    for wrong in (agents.shipped_seeds("ppo")[0], tmp_path / "none.onnx", damaged):
        assert train.main(["--algo", "ppo", "--from", str(wrong), "--out", str(tmp_path / "other")]) == 2
        assert wrong.name in capsys.readouterr().err
    for options in (["--algo", "sac", "--from", str(START)], ["--algo", "ppo-after-gradient"]):
        with pytest.raises(SystemExit):
            train.main([*options, "--out", str(tmp_path / "third")])
        assert "--from FILE goes with --algo ppo" in capsys.readouterr().err
