"""What users copy: each example learns, is judged, and leaves what it says."""

import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from cz_gym import CzEnv, agents, datasets
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from examples import cleanrl_ppo, gradient, sb3_ppo


@pytest.mark.usefixtures("few_crystals")
def test_the_stable_baselines_example_writes_an_agent(tmp_path: Path) -> None:
    contract = sb3_ppo.main(steps=40_000, out=tmp_path / "some.onnx")
    assert (contract.action, contract.algorithm, contract.training_steps) == ("smooth", "sb3-ppo", 65_536)
    assert agents.load(tmp_path / "some.onnx").contract == contract


@pytest.mark.usefixtures("few_crystals")
def test_the_gradient_example_writes_an_agent(tmp_path: Path) -> None:
    contract = gradient.main(steps=1440, num_envs=8, out=tmp_path / "some.onnx")
    assert (contract.action, contract.observation, contract.training_steps) == ("rate", "measured", 1440)
    assert "0.175 hot-zone" in contract.scenario
    assert agents.load(tmp_path / "some.onnx").contract == contract


@pytest.mark.parametrize("name", ["gradient", "cleanrl_ppo", "offline_td3_bc"])
def test_an_example_without_its_packages_says_in_one_line_what_to_install(name: str) -> None:
    command = [sys.executable, "-S", "-m", f"examples.{name}"]  # -S: nothing but Python's own modules
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(r"\w+ is missing: .*pip install .*\n", done.stderr)


@pytest.mark.parametrize("steps", [8192, pytest.param(262_144, marks=pytest.mark.slow)])
def test_the_cleanrl_example_learns(
    steps: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It judges itself eight times, or after each update of a few, and at its end says what it returns."""
    monkeypatch.setattr(cleanrl_ppo, "VALIDATION_SEEDS", cleanrl_ppo.VALIDATION_SEEDS[:8])
    found = cleanrl_ppo.main(cleanrl_ppo.Args(steps=steps, num_envs=64, minibatch=1024))
    said = capsys.readouterr().out.splitlines()
    assert len(said) == min(8, steps // 4096)
    assert said[-1].startswith(
        f"{steps:>9,} steps: radius error {found.rmse_mm:.3f} mm, {100 * found.failure_rate:.0f} %"
    )
    assert steps < 100_000 or found.failure_rate < 1.0, "it has learned to hold some crystals"


@pytest.fixture
def offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The offline example, and a dataset for it."""
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    from examples import offline_td3_bc

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return offline_td3_bc


def recorded(crystals: int) -> list[str]:
    """The name of a dataset of the re-tuned PID."""
    source = datasets.find_policy("paper-tuned", make_config("randomized"))
    return [datasets.write("paper-tuned", source, seeds=TRAINING_SEEDS[:crystals]).id]


def test_the_offline_example_reads_smooth_actions_and_says_what_it_returns(
    offline: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Actions as it reads them pull the crystal that was recorded."""
    with pytest.raises(FileNotFoundError, match="not found locally"):
        offline.main(["cz/randomized/paper-tuned-v0"])
    names = recorded(1)
    (seen, *_, mean, spread), _, actions, _, lost = offline.read(names)
    with closing(CzEnv()) as env:
        found = [env.reset(seed=0)[0], *(env.step(action)[0] for action in actions[:-1].numpy())]
    np.testing.assert_allclose(seen * spread + mean, np.stack(found), atol=2e-3)
    assert not lost.any()
    monkeypatch.setattr(offline, "VALIDATION_SEEDS", offline.VALIDATION_SEEDS[:2])
    judged = offline.main(names, updates=30)
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == ["11", "30"]
    assert f"radius error {judged.rmse_mm:.3f} mm, {100 * judged.failure_rate:.0f} %" in said[-1]


@pytest.mark.slow
def test_the_offline_example_holds_crystals_after_learning_from_others(
    offline: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(offline, "VALIDATION_SEEDS", offline.VALIDATION_SEEDS[:20])
    found = offline.main(recorded(100), updates=6000)
    assert found.failure_rate == 0.0
    assert found.rmse_mm < 0.15
