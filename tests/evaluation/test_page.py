"""``report.html``: what it holds is what was measured, whatever the names are, and it needs nothing from elsewhere."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import benchmark
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.env import CzEnv
from cz_gym.evaluation.protocol import find_row
from cz_gym.evaluation.report import page as page_module
from cz_gym.evaluation.report.page import SCRIPTS, _asset, embedded, page
from cz_gym.evaluation.report.page_signals import CURVES, SHARED, episodes, pack, unpack
from cz_gym.evaluation.report.page_tables import DISTRIBUTIONS, estimate_of, groups
from cz_gym.evaluation.results import Benchmark, Controller, Sample, ScenarioResult, summarise
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.observation import MEASURED, scales

EVIL = "</script><img src=x onerror=alert(1)>\"'&amp;<b>\u2028%{x}"
SEEDS = range(2_000_000, 2_000_003)


class Parts(HTMLParser):
    """The elements of a page, and the text of each script by its id (or number)."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str, str] = {}
        self._inside: str | None = None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "script":
            self._inside = dict(attrs).get("id") or str(len(self.scripts))
            self.scripts[self._inside] = ""

    def handle_endtag(self, tag: str) -> None:
        if tag == "script":
            self._inside = None

    def handle_data(self, data: str) -> None:
        if self._inside is not None:
            self.scripts[self._inside] += data


class Made:
    """A small benchmark, its rollouts and its page."""

    def __init__(self) -> None:
        self.runs: dict[tuple[str, str], Rollout] = {}
        scenarios = [self.scenario(name, ("open-loop", "paper", "industrial")) for name in ("puller", "reference-b")]
        contract = {"algorithm": EVIL, "training_seed": 4}
        self.benchmark = Benchmark(tuple(scenarios), f"benchmark.py --agent '{EVIL}'", (contract,))
        self.text = page(self.benchmark)
        self.parts = Parts(self.text)
        self.facts = json.loads(self.parts.scripts["facts"])
        self.episodes = json.loads(self.parts.scripts["episodes"])

    def scenario(self, name: str, names: Sequence[str]) -> ScenarioResult:
        """That row under those controllers; the last one is called an evil agent, and met one crystal less."""
        row = find_row(name)
        config, seeds, samples = row.config(), row.seeds(len(SEEDS)), []
        for who in names:
            evil = who == names[-1]
            run = rollout(find_controller(who).make(config), config, seeds[: len(seeds) - evil] or seeds)
            self.runs[name, who] = run
            agent = Controller(EVIL, "measured", f"agent trained with {EVIL}", (4, 7)) if evil else None
            runs = [run, run] if evil else [run]
            samples.append(Sample.of(agent or Controller(who, "measured", f"what {who} is"), runs))
        return summarise(row, samples)


@pytest.fixture(scope="module")
def made() -> Made:
    return Made()


def test_the_verdict_is_the_first_thing_in_the_page(made: Made) -> None:
    body = made.text[made.text.index("<body>") :]
    first = re.search(r"<(p|h1|h2|div|section)[^>]*>", body)
    assert first is not None
    assert 'id="verdict"' in first[0]
    assert made.facts["verdict"].startswith("The agent " + EVIL)


def test_the_table_is_the_results_to_six_digits(made: Made) -> None:
    columns = [column for group in groups(made.benchmark) for column in group.columns]
    assert [column["name"] for column in made.facts["columns"]] == [c.heading.partition(" [")[0] for c in columns]
    for told, scenario in zip(made.facts["scenarios"], made.benchmark.scenarios, strict=True):
        assert told["name"] == scenario.row.name
        assert told["seeds"] == list(scenario.seeds)
        for row, outcome in zip(told["rows"], scenario.outcomes, strict=True):
            assert row["crystals"] == len(outcome.sample.seeds)
            for cell, column in zip(row["cells"], columns, strict=True):
                estimate = estimate_of(outcome, column.metric)
                if estimate is None:
                    assert cell is None
                    continue
                wanted = [value / column.unit for value in (estimate.mean, *(estimate.ci95 or ()))]
                np.testing.assert_allclose(cell, wanted, rtol=5e-6)


def test_every_metric_has_a_column_with_a_unit(made: Made) -> None:
    headings = [column.heading for group in groups(made.benchmark) for column in group.columns]
    for metric in made.benchmark.scenarios[0].outcomes[0].means:
        assert any(column.metric == metric for group in groups(made.benchmark) for column in group.columns)
    assert all("[" in heading for heading in headings if heading not in ("return", "cost"))


def test_distributions_are_the_episodes_to_five_digits(made: Made) -> None:
    for told, scenario in zip(made.facts["scenarios"], made.benchmark.scenarios, strict=True):
        for found, outcome in zip(told["distributions"], scenario.outcomes, strict=True):
            for values, column in zip(found, DISTRIBUTIONS, strict=True):
                assert len(values) == outcome.sample.values[:, :, 0].size
                np.testing.assert_allclose(values, outcome.sample.metric(column.metric).ravel(), rtol=5e-5)


def test_signals_are_the_rollouts_to_half_a_resolution(made: Made) -> None:
    resolutions = [curve.resolution for curve in CURVES]
    for told, (name, who) in zip(
        [run for scenario in made.episodes for run in scenario[0]["runs"]], made.runs, strict=True
    ):
        signals = made.runs[name, who].episode(0)
        found = dict(zip([c.key for c in CURVES], unpack(told["packed"], resolutions), strict=True))
        assert told["steps"] == len(signals.r_c)
        assert told["failed"] == bool(made.runs[name, who].failed[0])
        for key, wanted in (
            ("r_c", signals.r_c * 1e3), ("h_c", signals.h_c * 1e3), ("v_p", signals.v_p * 6e4),
            ("v_g", signals.v_g * 6e4), ("Q_H", signals.Q_H / 1e3), ("T_1", signals.T_1), ("T_b", signals.T_b),
            ("alpha_c", signals.alpha_c * 180 / np.pi),
        ):  # fmt: skip
            half = resolutions[[c.key for c in CURVES].index(key)] / 2
            np.testing.assert_allclose(found[key], wanted, rtol=0, atol=half * (1 + 1e-6))
        np.testing.assert_allclose(
            found["camera"] - found["ring"], (signals.r_br_measured - signals.r_br) * 1e3, atol=1e-3
        )


def test_the_camera_reading_is_what_the_controller_gets(made: Made) -> None:
    """The environment's own observation, which is less the operator's bias and the reference, is the oracle."""
    told = made.episodes[0][0]
    camera = unpack(told["runs"][0]["packed"], [curve.resolution for curve in CURVES])[1]
    r_ref = unpack(told["packed"], [curve.resolution for curve in SHARED])[0]
    env = CzEnv("puller")
    env.reset(seed=told["seed"])
    scale = scales(MEASURED, make_config().parameters.v_0)[0]
    for k in range(200):
        observation, *_ = env.step(np.zeros(2, np.float32))
        assert camera[k] - r_ref[k] == pytest.approx(1e3 * observation[0] * scale, abs=2e-3)


def test_what_controllers_share_is_the_same_for_all(made: Made) -> None:
    for name, scenario in zip(("puller", "reference-b"), made.episodes, strict=True):
        for i, told in enumerate(scenario):
            shared = unpack(told["packed"], [curve.resolution for curve in SHARED])
            for (of, _), run in made.runs.items():
                if of == name and i < len(run.seeds):
                    for curve, values in zip(SHARED, shared, strict=True):
                        own = curve.value(run.episode(i), 0.0)
                        np.testing.assert_allclose(values[: len(own)], own, atol=curve.resolution)
    assert [told["seed"] for told in made.episodes[0]] == list(SEEDS)


def test_a_controller_that_met_fewer_crystals_has_none_to_show(made: Made) -> None:
    assert made.episodes[0][-1]["runs"][-1] is None
    assert made.episodes[0][-1]["runs"][0] is not None


def test_a_signal_that_is_no_number_ends_the_curve(made: Made) -> None:
    scenario = made.benchmark.scenarios[1]
    signals = scenario.outcomes[0].sample.examples[0]
    r_br = signals.r_br.copy()
    r_br[100:] = np.nan
    object.__setattr__(scenario.outcomes[0].sample, "examples", (signals._replace(r_br=r_br),))
    try:
        assert [run["steps"] for run in episodes(scenario)[0]["runs"]] == [100, 2160, 2160]
    finally:
        object.__setattr__(scenario.outcomes[0].sample, "examples", (signals,))


@given(st.lists(st.lists(st.integers(-(2**40), 2**40), min_size=3, max_size=3), min_size=1, max_size=4))
def test_packing_loses_nothing(rows: list[list[int]]) -> None:
    packed = pack([(np.array(row, np.float64), 1.0) for row in rows])
    for found, row in zip(unpack(packed, [1.0] * len(rows)), rows, strict=True):
        np.testing.assert_array_equal(found, row)


@given(st.text())
def test_no_text_ends_the_script_it_is_in(text: str) -> None:
    """An HTML parser sees one script and finds the text in it unchanged."""
    parts = Parts(f'<script id="facts">{embedded([text])}</script>')
    assert [tag for tag, _ in parts.elements] == ["script"]
    assert json.loads(parts.scripts["facts"]) == [text]


def test_a_name_that_is_markup_stays_text(made: Made) -> None:
    assert made.facts["controllers"][-1]["name"] == EVIL
    assert made.facts["command"].endswith(f"'{EVIL}'")
    tags = [tag for tag, _ in made.parts.elements]
    assert tags.count("script") == 4
    assert "img" not in tags
    assert "<img" not in made.text.replace(made.parts.scripts["2"], "")


def test_no_script_writes_markup() -> None:
    for name in SCRIPTS:
        assert not re.search(
            r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function", _asset(name)
        )


def test_nothing_is_fetched(made: Made) -> None:
    """No address in the page but plotly's own, no element that loads, and a policy that forbids it all the same."""
    own = made.text.replace(made.parts.scripts["2"], "")
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", own.replace(EVIL, ""))
    for tag, attributes in made.parts.elements:
        assert "src" not in attributes
        assert tag not in ("iframe", "object", "embed", "img")
        assert attributes.get("href", "#").startswith(("#", "data:"))
    policies = [a["content"] for tag, a in made.parts.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    assert policies[0].startswith("default-src 'none'; ")
    assert "connect-src" not in policies[0]


def test_the_same_results_give_the_same_bytes(made: Made) -> None:
    assert page(made.benchmark).encode() == made.text.encode()


def test_without_the_reference_there_is_no_comparison() -> None:
    few = Made.__new__(Made)
    few.runs = {}
    alone = Benchmark((few.scenario("reference-b", ("open-loop",)),), "", ())
    told = page_module.facts(alone)
    assert {column["group"] for column in told["columns"]} == {"Error of the true radius", "Crystal", "Drives"}
    assert json.loads(Parts(page(alone)).scripts["episodes"])[0][0]["runs"][0]["steps"] == 2160


SMALL = ["--scenarios", "reference-b", "--controllers", "open-loop", "--quiet"]


def test_a_page_that_cannot_be_written_leaves_no_neighbours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "report.html").mkdir()
    assert benchmark.main([*SMALL, "--out", str(tmp_path), "--overwrite"]) == 2
    line = capsys.readouterr().err
    assert "report.html" in line
    assert line.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_json_alone_needs_no_plotly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    assert benchmark.main([*SMALL, "--json", str(tmp_path / "lone.json")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["lone.json"]


def test_a_page_is_kept_like_its_neighbours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "report.html").write_text("mine")
    assert benchmark.main([*SMALL, "--out", str(tmp_path)]) == 2
    assert "report.html exists" in capsys.readouterr().err
    assert (tmp_path / "report.html").read_text() == "mine"


def test_every_controller_can_be_told_from_the_others() -> None:
    names = [f"c{i}" for i in range(24)]
    told: list[dict[str, Any]] = page_module._controllers(tuple(Controller(name, "measured", "") for name in names))
    assert len({(one["colour"], one["dash"]) for one in told}) == len(names)
