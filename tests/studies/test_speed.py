"""The speed command's structure on a tiny run; what it measures is never tested."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies.speed import __main__ as speed
from studies.speed import cases as speed_cases
from studies.speed import costs as speed_costs
from studies.speed import peers as speed_peers
from studies.speed.__main__ import RATIOS, Plan, Row, main, measure, more_figures, ratios
from studies.speed.cases import Case, Skipped


def small(plan: Plan) -> list[Case]:
    found = [*speed_cases.scalars()[:2], speed_cases.ours(8, 1), speed_cases.ours(8, 2, "history")]
    return [*found, speed_cases.in_step(8, 1), speed_cases.bare(8, 1), speed_cases.plain_numpy(8)]


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "QUICK", Plan(2, 0.0, 8))
    monkeypatch.setattr(speed, "own_cases", small)
    monkeypatch.setattr(speed, "costs", lambda quick: {"memory_per_slot_randomized_kib": 1.0})
    missing: list[Case | Skipped] = [Skipped(speed_peers.PCGYM, "pcgym is not installed")]
    monkeypatch.setattr(speed_peers, "peers", lambda quick: missing)


@pytest.mark.usefixtures("tiny")
def test_json_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new" / "speed.json"
    assert main(["--quick", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert list(found["ratios"]) == list(RATIOS)
    assert found["ratios"]["scalar_vs_pendulum"] > 0
    assert found["ratios"]["vector1024_vs_pcgym"] is None
    for row in found["rows"]:
        assert set(row) == {"name", "num_envs", "steps_per_s"}
        assert row["steps_per_s"] > 0
    assert found["skipped"] == [{"name": "pc-gym CSTR", "why": "pcgym is not installed"}]
    said = capsys.readouterr().out
    assert all(name in said for name in (*RATIOS, "skipped: pcgym is not installed", "Pendulum-v1 scalar"))


@pytest.mark.usefixtures("tiny")
def test_a_file_that_cannot_be_written_is_one_line_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "run", lambda *_: pytest.fail("measured"))
    (tmp_path / "file").write_text("in the way")
    for file in (tmp_path, tmp_path / "file" / "below.json"):
        assert main(["--json", str(file)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert str(file.parent) in said


def test_a_case_counts_the_steps_of_every_slot() -> None:
    seen = []
    case = Case("counted", 10, lambda: seen.append(1), lambda: seen.append(2), calls=3)
    rows = measure([[case]], Plan(2, 0.0, 1))
    assert seen == [1] * 7 + [2]
    assert (rows[0].name, rows[0].num_envs) == ("counted", 10)


def test_ratios_are_of_like_with_like() -> None:
    rows = [
        Row("Cz-v0 scalar", 1, 6.0), Row("Pendulum-v1 scalar", 1, 2.0),
        Row("Cz-v0 batch, measured, 1 thread", 1024, 100.0), Row("Cz-v0 batch, measured, 2 threads", 1024, 180.0),
        Row("Cz-v0 batch, measured, 1 thread", 4096, 900.0), Row("Cz-v0 batch, history, 2 threads", 1024, 999.0),
        Row("EnvPool Pendulum-v1, 1 thread", 1024, 60.0), Row("EnvPool Pendulum-v1, 2 threads", 1024, 30.0),
        Row("Cz-v0 batch without resets, 1 thread", 1024, 3.0),
        Row("bare compiled plant and ring, 1 thread", 1024, 4.0),
        Row("SB3 adapter over the batch", 256, 50.0), Row("SB3 SubprocVecEnv, 2 processes", 2, 5.0),
        Row("SB3 SubprocVecEnv, 16 processes", 16, 10.0),
    ]  # fmt: skip
    assert ratios(rows) == {
        "scalar_vs_pendulum": 3.0,
        "vector1024_vs_envpool_pendulum": 3.0,
        "vector1024_vs_pcgym": None,
        "vector1024_vs_kernel": 0.75,
        "sb3_adapter_vs_subproc": 5.0,
        "sb3_adapter_vs_dummy": None,
    }
    assert more_figures(rows)["vector1024_vs_envpool_pendulum_one_thread"] == pytest.approx(100 / 60)


def test_a_peer_that_is_missing_or_breaks_is_skipped_by_name() -> None:
    def missing(name: str) -> Case:
        raise ModuleNotFoundError("No module named 'envpool'", name="envpool")

    def broken(name: str) -> Case:
        raise RuntimeError("two\nlines")

    assert speed_peers._try("peer", missing) == Skipped("peer", "envpool is not installed")
    assert speed_peers._try("peer", broken) == Skipped("peer", "RuntimeError: two lines")


def test_spread_out_slots_truncate_at_different_times() -> None:
    env = speed_cases.CzVectorEnv(32, "nominal", horizon=100.0)
    speed_cases.spread_out(env)
    ends = [int(env.step(np.zeros((32, 2)))[3].sum()) for _ in range(21)]
    assert sum(ends) >= 32
    assert max(ends) < 16


def test_memory_of_a_slot_is_within_its_bound() -> None:
    if not speed_costs.resident():
        pytest.skip("the system does not say how much memory a process uses")
    assert 1.0 < speed_costs.memory_per_slot("randomized", "measured") / speed_costs.KIB < 80.0
    assert speed_costs.memory_per_slot("puller", "history") / speed_costs.KIB < 160.0


def test_the_plain_numpy_batch_runs_the_same_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    kept = speed_cases.State
    monkeypatch.setattr(speed_cases, "State", lambda *values: made.append(kept(*values)) or made[-1])
    case = speed_cases.plain_numpy(3)
    for _ in range(10):
        case.step()
    np.testing.assert_allclose(made[0].r_c, 87.5e-3, rtol=1e-9)


def test_a_masked_reset_of_a_batch_with_padded_info_keeps_the_other_slots() -> None:
    env = speed_cases.CzVectorEnv(64, horizon=600.0)
    env.reset(seed=0)
    before = env.step(np.full((64, 2), 0.1))
    mask = np.arange(64) % 3 == 0
    observation, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(observation[~mask], before[0][~mask])
    assert not np.array_equal(observation[mask], before[0][mask])
    assert info["r_c"].shape == (64,)
    assert info["_r_c"].tolist() == mask.tolist()
    np.testing.assert_array_equal(env._out.info[0, :64][~mask], before[4]["r_c"][~mask])


def test_cases_without_resets_have_none() -> None:
    """Over and over the same minutes: slots come back to where they were, and none is redrawn."""
    for make in (speed_cases.in_step, speed_cases.bare):
        case = make(64, 1)
        batch = inspect.getclosurevars(case.step).nonlocals["first"]
        slots = inspect.getclosurevars(case.step).nonlocals["slots"]
        for _ in range(3 * speed_cases._UNFAILED):
            case.step()
            assert not slots["over"].any()
        assert slots.tobytes() == batch.tobytes()
        case.close()


def test_a_peer_that_warns_is_not_heard(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    def peer(quick: bool) -> list[Case | Skipped]:
        def step() -> None:
            warnings.warn("look at me", UserWarning, stacklevel=1)
            subprocess.run([sys.executable, "-c", "import warnings; warnings.warn('me too')"], check=True)

        return [Case("loud", 1, step, lambda: None)]

    monkeypatch.setattr(speed, "QUICK", Plan(1, 0.0, 8))
    monkeypatch.setattr(speed, "own_cases", lambda plan: [])
    monkeypatch.setattr(speed, "more_figures", lambda rows: {})
    monkeypatch.setattr(speed, "costs", lambda quick: {})
    monkeypatch.setattr(speed_peers, "peers", peer)
    monkeypatch.delenv("PYTHONWARNINGS", raising=False)
    assert main(["--quick"]) == 0
    assert capfd.readouterr().err == ""
    assert "PYTHONWARNINGS" not in os.environ
