"""Model cards: every shipped agent has one, with the benchmark's own figures."""

import json
from pathlib import Path
from typing import Any

from cz_gym import agents
from studies.cards import __main__ as cards

RESULTS = Path(__file__).parents[2] / "results"
BENCHMARK, FRONTIER = (RESULTS / name / "benchmark.json" for name in ("benchmark", "frontier"))


def test_every_shipped_agent_has_a_card_and_the_committed_ones_are_of_the_committed_results(tmp_path: Path) -> None:
    assert {path.stem.rpartition("-seed")[0] for path in agents.MODELS.glob("*.onnx")} == set(cards.AGENTS)
    assert cards.main(["--benchmark", str(BENCHMARK), str(FRONTIER), "--out", str(tmp_path / "cards.md")]) == 0
    page = (tmp_path / "cards.md").read_text()
    benchmark, frontier = (json.loads(path.read_text())["results"]["puller"] for path in (BENCHMARK, FRONTIER))
    assert (RESULTS / "cards" / "cards.md").read_text() == page
    for name in cards.AGENTS:
        section = page.split(f"## `{name}`")[1].split("\n## ")[0]
        found = benchmark.get(name) or frontier[name]
        assert f"| puller | {found['rmse_mm']['mean']:.4f} [" in section
        assert ("`puller`" in section.split("Fails: ")[1].split("\n")[0]) == (found["failure_rate"]["mean"] > 0.0)


def test_another_file_is_refused_in_one_line(tmp_path: Path, refused: Any) -> None:
    (tmp_path / "some.json").write_text("[]")
    command = ["--benchmark", str(tmp_path / "some.json"), "--out", str(tmp_path / "cards.md")]
    assert "no benchmark.json with gradient" in refused(cards.main, command)
