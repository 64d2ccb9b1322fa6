"""The same bits everywhere, and golden trajectories that notice any change of physics."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import benchmark
from cz_gym import SCENARIOS, CzVectorEnv, Parameters
from tests.golden.digest import digest
from tests.golden.trajectories import FILE, SIGNALS, trajectories, trajectory

ROOT = Path(__file__).parents[2]
GOLDEN: dict[str, Any] = json.loads(FILE.read_text())


def test_golden_trajectories() -> None:
    found = trajectories()
    assert found.keys() == GOLDEN.keys()
    assert len(found) == 2 * len(SCENARIOS)
    for name, rows in found.items():
        np.testing.assert_allclose(rows, GOLDEN[name], rtol=1e-9, atol=0.0, err_msg=name)


@pytest.mark.parametrize("name", Parameters._fields)
def test_goldens_notice_a_change_of_any_parameter(name: str) -> None:
    """By a millionth: of what the plant is made of, whatever the scenario."""
    changed = Parameters()._replace(**{name: getattr(Parameters(), name) * (1.0 + 1e-6)})
    rows = np.array(trajectory("randomized", "I", changed))
    assert rows.shape == (2, len(SIGNALS) + 1)
    assert not np.allclose(rows, GOLDEN["randomized, I"], rtol=1e-9, atol=0.0)


def test_the_same_bits_in_another_process() -> None:
    """And from an installed wheel: ``tests/project/test_packaging.py``."""
    command = [sys.executable, "-m", "tests.golden.digest"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [digest(), str(ROOT / "cz_gym" / "__init__.py")]


def test_thread_counts_do_not_change_bits() -> None:
    digests = set()
    for threads in (1, 2, 3):
        env = CzVectorEnv(780, "puller", horizon=50.0, threads=threads, info="all")
        assert env._batch._parts == threads
        found, rng = hashlib.sha256(env.reset(seed=3)[0].tobytes()), np.random.default_rng(1)
        for _ in range(14):
            observation, reward, _, _, infos = env.step(rng.uniform(-1, 1, (780, 2)))
            found.update(observation.tobytes() + reward.tobytes() + infos["r_c"].tobytes() + infos["T_b"].tobytes())
        env.close()
        digests.add(found.hexdigest())
    assert len(digests) == 1


def times(results: Any, taken: list[float]) -> Any:
    """The results without what was timed, which is put into ``taken``."""
    if isinstance(results, list):
        return [times(part, taken) for part in results]
    if not isinstance(results, dict):
        return results
    timed = results.get("microseconds_per_step")
    taken += [timed] if isinstance(timed, float) else [v for v in (timed or {}).values() if isinstance(v, float)]
    return {name: times(part, taken) for name, part in results.items() if name != "microseconds_per_step"}


@pytest.mark.slow
def test_the_benchmark_prints_the_same_table_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Here and in a process of its own, and the same JSON; all but the time in the policies, which is measured."""
    printed, written = [], []
    for run in ("here", "elsewhere"):
        file = tmp_path / f"{run}.json"
        options = ["--episodes", "2", "--controllers", "open-loop,paper", "--scenarios", "randomized,nominal"]
        options += ["--json", str(file)]
        if run == "here":
            assert benchmark.main(options) == 0
            table = capsys.readouterr().out
        else:
            command = [sys.executable, str(ROOT / "benchmark.py"), *options]
            table = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        taken: list[float] = []
        found = times(json.loads(file.read_text()), taken)
        shown = {f"{value:.2f}" for value in taken}
        assert len(shown) >= 2
        lines = [line.split() for line in table.splitlines() if ".json" not in line]
        printed.append([[token for token in line if token not in shown] for line in lines])
        written.append({name: found[name] for name in ("results", "paired", "cvar5", "verdicts")})
    assert printed[0] == printed[1] != []
    assert written[0] == written[1]
