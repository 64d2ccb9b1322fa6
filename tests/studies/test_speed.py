"""The speed command's structure on a tiny run; its measurements are never tested."""

import json
import timeit
from functools import partial

import gymnasium as gym
import pytest

from studies import speed

SMALL = {
    "Cz-v0 scalar": partial(gym.make, "Cz-v0"),
    "Pendulum-v1 scalar": partial(gym.make, "Pendulum-v1"),
    "Cz-v0 batch, measured, 2 threads": partial(speed.our_batch, 8, 2),
    "bare compiled plant and ring, 1 thread": partial(speed.bare_plant, 8, 1),
}


@pytest.fixture(autouse=True)
def one_call(monkeypatch):
    monkeypatch.setattr(timeit.Timer, "autorange", lambda timer: (1, 0.0))


def test_the_speed_command_writes_json_and_prints_a_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(speed, "cases", lambda: {**SMALL, "peer": partial(__import__, "no_such_package")})
    file = tmp_path / "new" / "speed.json"
    assert speed.main(["--quick", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert list(found["ratios"]) == [*speed.RATIOS]
    assert found["ratios"]["scalar_vs_pendulum"] > 0
    assert found["ratios"]["vector1024_vs_envpool_pendulum"] is None
    assert [(row["name"], row["steps_per_s"] > 0) for row in found["rows"]] == [(name, True) for name in SMALL]
    assert found["skipped"] == {"peer": "ModuleNotFoundError: No module named 'no_such_package'"}
    said = capsys.readouterr().out
    assert all(name in said for name in (*found["ratios"], "skipped: ModuleNotFoundError", "Pendulum-v1 scalar"))


@pytest.mark.slow
def test_every_row_of_ours_can_be_made_and_steps():
    wanted = {name: make for name, make in speed.cases(8, 2).items() if not name.startswith("EnvPool")}
    result = speed.measure(wanted, 1)
    assert result["skipped"] == {}
    assert len(result["rows"]) == len(wanted)
