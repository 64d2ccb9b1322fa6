"""Model cards: every shipped agent has one, with the benchmark's own figures."""

import json

import yaml

from cz_gym import agents
from studies import cards

FIGURES = {key: {"mean": 0.0, "ci95": [0.0, 0.5]} for key in (*(of.metric for of in cards.FIGURES), cards.RETURN)}


def test_every_shipped_agent_has_a_card_with_the_benchmark_s_figures(tmp_path):
    shipped = agents.shipped_names()
    assert set(shipped) <= set(cards.AGENTS)
    lost = {**FIGURES, "rmse_mm": {"mean": 1.25, "ci95": [1.0, 2.0]}, "failure_rate": {"mean": 0.25, "ci95": None}}
    results = {
        "hard": dict.fromkeys(cards.AGENTS, FIGURES),
        "puller": {**dict.fromkeys(cards.AGENTS, FIGURES), "ppo": lost},
    }
    (tmp_path / "benchmark.json").write_text(json.dumps({"results": results}))
    command = ["--benchmark", str(tmp_path / "benchmark.json"), "--out", str(tmp_path / "cards.md")]
    assert cards.main([*command, "--hub", str(tmp_path / "hub")]) == 0
    _, metadata, text = (tmp_path / "hub" / "ppo" / "README.md").read_text().split("---\n")
    (entry,) = yaml.safe_load(metadata)["model-index"]
    assert [result["dataset"]["name"] for result in entry["results"]] == ["Cz-v0 hard", "Cz-v0 puller"]
    assert text.startswith("\n# `ppo`")
    agents.OnnxPolicy.load(tmp_path / "hub" / "ppo" / "ppo-seed0.onnx")
    sections = (tmp_path / "cards.md").read_text().split("\n## ")[1:]
    assert [section.split("`")[1] for section in sections] == shipped
    for section in sections:
        fails = section.startswith("`ppo`")
        assert ("loses crystals of `puller`." in section) == fails
        assert ("| puller | 1.2500 [1.0000, 2.0000] |" in section) == fails


def test_results_without_the_shipped_agents_are_refused(tmp_path, refused):
    (tmp_path / "some.json").write_text('{"results": {"hard": {}}}')
    command = ["--benchmark", str(tmp_path / "some.json"), "--out", str(tmp_path / "cards.md")]
    assert "no results of gradient, ppo" in refused(cards.main, command)
