"""The same bits everywhere, and golden trajectories that notice any change of physics."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "golden"))

from trajectories import FILE, SIGNALS, trajectories, trajectory

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv, Parameters

ROOT = Path(__file__).parents[1]
GOLDEN: dict[str, Any] = json.loads(FILE.read_text())
DIGEST = """
import hashlib
import numpy as np
from cz_gym import CzVectorEnv
import cz_gym
digest = hashlib.sha256()
for scenario in ("randomized", "puller", "sensor-fault"):
    env = CzVectorEnv(3, scenario, observation="history", control_interval=20.0, horizon=600.0)
    observation, infos = env.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(70):
        digest.update(observation.tobytes() + b"".join(np.asarray(infos[name]).tobytes() for name in sorted(infos)))
        observation, reward, terminated, truncated, infos = env.step(rng.uniform(-0.5, 0.5, (3, 2)))
        digest.update(reward.tobytes() + terminated.tobytes() + truncated.tobytes())
print(digest.hexdigest(), cz_gym.__file__)
"""


def digest(folder: Path, path: Path) -> list[str]:
    """Digest and origin, printed by a fresh process in ``folder`` that imports from ``path``."""
    environment = {**os.environ, "PYTHONPATH": str(path)}
    done = subprocess.run(
        [sys.executable, "-c", DIGEST], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_golden_trajectories() -> None:
    found = trajectories()
    assert found.keys() == GOLDEN.keys()
    assert len(found) == 2 * len(SCENARIOS)
    for name, rows in found.items():
        np.testing.assert_allclose(rows, GOLDEN[name], rtol=1e-9, atol=0.0, err_msg=name)


def test_goldens_are_small() -> None:
    assert FILE.stat().st_size < 20_000


@pytest.mark.parametrize("name", Parameters._fields)
def test_goldens_notice_a_change_of_any_parameter(name: str) -> None:
    """By a millionth: of what the plant is made of, whatever the scenario."""
    changed = Parameters()._replace(**{name: getattr(Parameters(), name) * (1.0 + 1e-6)})
    rows = np.array(trajectory("randomized", "I", changed))
    assert rows.shape == (2, len(SIGNALS) + 1)
    assert not np.allclose(rows, GOLDEN["randomized, I"], rtol=1e-9, atol=0.0)


def test_the_same_bits_in_another_process_and_from_an_installed_wheel(tmp_path: Path) -> None:
    """The wheel is unpacked where an installer would put it."""
    source, wheels, installed = tmp_path / "source", tmp_path / "wheels", tmp_path / "installed"
    for folder in ("cz_gym", "baselines", "agents"):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                target = source / file.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(file.read_bytes())
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (source / name).write_bytes((ROOT / name).read_bytes())
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    alone = ["--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "wheel", *alone, "--wheel-dir", str(wheels), str(source)], check=True, capture_output=True)
    wheel = next(wheels.glob("*.whl"))
    subprocess.run([*pip, "install", *alone, "--target", str(installed), str(wheel)], check=True, capture_output=True)
    ours, theirs = digest(tmp_path, ROOT), digest(tmp_path, installed)
    assert (Path(ours[1]).parents[1], Path(theirs[1]).parents[1]) == (ROOT, installed)
    assert ours[0] == theirs[0] == digest(tmp_path, ROOT)[0]


def test_thread_counts_do_not_change_bits() -> None:
    digests = set()
    for threads in (1, 2, 3):
        env = CzVectorEnv(780, "puller", horizon=50.0, threads=threads)
        assert env._batch._parts == threads
        found, rng = hashlib.sha256(env.reset(seed=3)[0].tobytes()), np.random.default_rng(1)
        for _ in range(14):
            observation, reward, _, _, infos = env.step(rng.uniform(-1, 1, (780, 2)))
            found.update(observation.tobytes() + reward.tobytes() + infos["r_c"].tobytes() + infos["T_b"].tobytes())
        env.close()
        digests.add(found.hexdigest())
    assert len(digests) == 1


def test_scalar_and_batch_give_the_same_bits() -> None:
    batch, alone = CzVectorEnv(5, "hard", horizon=100.0), CzEnv("hard", horizon=100.0)
    batch.reset(seed=20)
    alone.reset(seed=23)
    for k in range(20):
        action = np.array([0.3 * np.sin(k), -0.2], np.float32)
        observation, reward, *_, infos = batch.step(np.tile(action, (5, 1)))
        shown, gained, *_, info = alone.step(action)
        assert (observation[3].tobytes(), reward[3]) == (shown.tobytes(), gained)
        assert {name: infos[name][3] for name in info} == info


def times(results: Any, taken: list[float]) -> Any:
    """The results without what was timed, which is put into ``taken``."""
    if isinstance(results, list):
        return [times(part, taken) for part in results]
    if not isinstance(results, dict):
        return results
    timed = results.get("microseconds_per_step")
    taken += [timed] if isinstance(timed, float) else [v for v in (timed or {}).values() if isinstance(v, float)]
    return {name: times(part, taken) for name, part in results.items() if name != "microseconds_per_step"}


def test_the_benchmark_prints_the_same_table_twice(tmp_path: Path) -> None:
    """All but the time in the policies, which is measured; so are the numbers of the JSON."""
    printed, written = [], []
    for run in ("one", "two"):
        file = tmp_path / f"{run}.json"
        command = [
            sys.executable, str(ROOT / "benchmark.py"), "--episodes", "2", "--controllers", "open-loop,paper",
            "--scenarios", "randomized,nominal", "--json", str(file),
        ]  # fmt: skip
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        taken: list[float] = []
        found = times(json.loads(file.read_text()), taken)
        shown = {f"{value:.2f}" for value in taken}
        assert len(shown) >= 2
        lines = [line.split() for line in done.stdout.splitlines() if ".json" not in line]
        printed.append([[token for token in line if token not in shown] for line in lines])
        written.append({name: found[name] for name in ("results", "paired", "cvar5", "verdicts")})
    assert printed[0] == printed[1] != []
    assert written[0] == written[1]
