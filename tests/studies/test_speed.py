"""The speed command's structure on a tiny run; what it measures is never tested."""

import inspect
import json
import timeit
from functools import partial
from pathlib import Path

import gymnasium as gym
import pytest

from studies.speed import __main__ as speed
from studies.speed import cases
from studies.speed.__main__ import RATIOS, Row, main, measure, ratio
from studies.speed.cases import Case

SMALL = [
    Case("Cz-v0 scalar", partial(gym.make, "Cz-v0")),
    Case("Pendulum-v1 scalar", partial(gym.make, "Pendulum-v1")),
    Case("Cz-v0 batch, measured, 2 threads", partial(cases.ours, 8, 2)),
    Case("bare compiled plant and ring, 1 thread", partial(cases.bare, 8, 1)),
    Case("Cz-v0 batch, measured, 1 thread", partial(cases.ours, 8)),
]


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "QUICK", 2)
    monkeypatch.setattr(timeit.Timer, "autorange", lambda timer: (1, 0.0))
    monkeypatch.setattr(speed, "cases", lambda quick: [*SMALL, Case("peer", partial(__import__, "no_such_package"))])


@pytest.mark.usefixtures("tiny")
def test_json_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new" / "speed.json"
    assert main(["--quick", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert list(found["ratios"]) == [*RATIOS]
    assert found["ratios"]["scalar_vs_pendulum"] > 0
    assert found["ratios"]["vector1024_vs_pcgym"] is None
    assert [(row["name"], row["steps_per_s"] > 0) for row in found["rows"]] == [(case.name, True) for case in SMALL]
    assert found["skipped"] == {"peer": "ModuleNotFoundError: No module named 'no_such_package'"}
    said = capsys.readouterr().out
    assert all(name in said for name in (*found["ratios"], "skipped: ModuleNotFoundError", "Pendulum-v1 scalar"))


@pytest.mark.slow
def test_every_row_of_ours_can_be_made_and_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timeit.Timer, "autorange", lambda timer: (1, 0.0))
    monkeypatch.setattr(cases, "SLOTS", 8)
    monkeypatch.setattr(cases, "SB3_SLOTS", 2)
    wanted = [case for case in cases.cases(True) if "EnvPool" not in case.name and case.name != "pc-gym CSTR"]
    rows, skipped = measure(wanted, 1)
    assert skipped == {}
    assert len(rows) == len(wanted)


def test_ratios_are_of_like_with_like() -> None:
    rows = [
        Row("Cz-v0 scalar", 1, 6.0), Row("Pendulum-v1 scalar", 1, 2.0),
        Row("Cz-v0 batch, measured, 1 thread", 1024, 100.0), Row("Cz-v0 batch, measured, 2 threads", 1024, 180.0),
        Row("Cz-v0 batch, measured, 1 thread", 4096, 900.0), Row("Cz-v0 batch, history, 2 threads", 1024, 999.0),
        Row("EnvPool Pendulum-v1, 1 thread", 1024, 60.0), Row("EnvPool Pendulum-v1, 2 threads", 1024, 30.0),
        Row("SB3 adapter over the batch", 256, 50.0), Row("SB3 SubprocVecEnv, 2 processes", 2, 5.0),
        Row("SB3 SubprocVecEnv, 16 processes", 16, 10.0),
    ]  # fmt: skip
    found = {name: ratio(rows, asked) for name, asked in RATIOS.items()}
    assert {name: value for name, value in found.items() if value is not None} == {
        "scalar_vs_pendulum": 3.0,
        "vector1024_vs_envpool_pendulum": 3.0,
        "vector1024_vs_envpool_pendulum_one_thread": 100.0 / 60.0,
        "sb3_adapter_vs_subproc": 5.0,
    }


def test_cases_without_resets_have_none() -> None:
    """Over and over the same minutes: slots come back to where they were, and none is redrawn."""
    for make in (cases.without_resets, cases.bare):
        case = make(64, 1)
        memory = inspect.getclosurevars(case.step).nonlocals
        for _ in range(3 * cases.UNFAILED):
            case.step()
            assert not memory["slots"]["over"].any()
        assert memory["slots"].tobytes() == memory["first"].tobytes()
        case.close()
