"""Time against nodes: the model's parts, and what it says of many machines."""

from __future__ import annotations

from typing import Any

import pytest

from studies.cluster import __main__ as study

MODEL = study.Model(connect=1.0, load=3.0, t=2.0, d=0.01)


def test_the_model_adds_its_parts() -> None:
    assert MODEL.seconds(1, 10_000) == pytest.approx(1.0 + 3.0 + 2.0 + 0.01)
    assert MODEL.seconds(7, 2) == pytest.approx(4.0 + 4 * 2.0 + 0.07)
    assert MODEL.most == pytest.approx(200.0)
    told = study.forecast(MODEL)
    assert "| 10,000 | 16 s (125.9 x) |" in told
    assert "serves 100 tasks a second. It saturates first, at 200 machines if a task takes 2.00 s" in told
    assert "10,000 machines need tasks of 100 s" in told


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_one_and_two_nodes_are_measured(capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setattr(study, "EMPTY", 5)
    assert study.main(["--tasks", "2", "--crystals", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" |")[0] for line in lines if line[:3] in ("| 1", "| 2")][:2] == ["| 1", "| 2"]
