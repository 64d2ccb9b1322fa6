"""Time against nodes, measured on one and two of them."""

from typing import Any

import pytest

from studies.cluster import __main__ as study


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_one_and_two_nodes_are_measured(capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setattr(study, "EMPTY", 5)
    assert study.main(["--tasks", "2", "--crystals", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" |")[0] for line in lines if line[:3] in ("| 1", "| 2")][:2] == ["| 1", "| 2"]
