"""``report.html``: what it holds is what was measured, whatever the names are, and it needs nothing from elsewhere."""

import base64
import json
import re
import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import benchmark
from cz_gym.config import make_config
from cz_gym.env import CzEnv
from cz_gym.evaluation.report.canvas import styles_of
from cz_gym.evaluation.report.page import _asset, embedded, page
from cz_gym.evaluation.report.page_figures import DISTRIBUTIONS, errors, pareto, plain
from cz_gym.evaluation.report.page_signals import OWN, PANELS, SHARED, crystals, frame, pack
from cz_gym.evaluation.report.tables import DRIVES, ERROR, comparison
from cz_gym.evaluation.results import Benchmark, Controller
from cz_gym.observation import MEASURED, scales
from tests.samples import scenario_of

EVIL = "</script><img src=x onerror=alert(1)>\"'&amp;<b>\u2028%{x}"
ROWS, NAMES = ("puller", "reference-b"), ("open-loop", "paper", "industrial")


class Parts(HTMLParser):
    """The elements of a page, the text of each script by its id (or number), and the cells of its tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.rows: list[list[tuple[str | None, str]]] = []
        self._script: str | None = None
        self._in_cell = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "script":
            self._script = dict(attrs).get("id") or str(len(self.texts))
            self.texts[self._script] = ""
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._in_cell = True
            self.rows[-1].append((dict(attrs).get("data-value"), ""))

    def handle_endtag(self, tag: str) -> None:
        self._script = None if tag == "script" else self._script
        self._in_cell = self._in_cell and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        if self._script is not None:
            self.texts[self._script] += data
        elif self._in_cell:
            value, text = self.rows[-1][-1]
            self.rows[-1][-1] = value, text + data


def whole_numbers(text: str, lines: int) -> np.ndarray:
    """What was packed, in steps of the resolutions, shape (lines, steps)."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(4, -1)
    changes = np.ascontiguousarray(planes.T).view("<i4").reshape(lines, -1)
    return changes.cumsum(axis=1, dtype=np.int64)


def unpack(text: str, lines: Sequence[tuple[int, str]]) -> dict[tuple[str, str], np.ndarray]:
    """Values by panel and line."""
    whole = zip(lines, whole_numbers(text, len(lines)), strict=True)
    return {(PANELS[panel].title, name): values * PANELS[panel].resolution for (panel, name), values in whole}


class Made:
    """A small benchmark, its rollouts and its page. The last controller is called an evil agent of two seeds, and met
    one crystal less."""

    def __init__(self) -> None:
        scenarios, runs = zip(*(scenario_of(name, NAMES, EVIL, (4, 7), fewer=1) for name in ROWS), strict=True)
        self.runs = {(name, who): run for name, some in zip(ROWS, runs, strict=True) for who, run in some.items()}
        self.benchmark = Benchmark(scenarios, f"benchmark.py --agent '{EVIL}'", ())
        self.text = page(self.benchmark)
        self.parts = Parts(self.text)
        self.data = json.loads(self.parts.texts["data"])
        self.crystals = [scenario["crystals"] for scenario in self.data["scenarios"]]


@pytest.fixture(scope="module")
def made() -> Made:
    return Made()


def test_the_verdict_is_the_first_thing_in_the_page(made: Made) -> None:
    body = made.text[made.text.index("<body>") + len("<body>") :].lstrip()
    assert body.startswith('<p id="verdict">')


def test_the_tables_are_the_results(made: Made) -> None:
    """Every metric has a column with a unit; numbers that sort are exact, those that are read are rounded."""
    rows = iter(made.parts.rows)
    for scenario in made.benchmark.scenarios:
        columns = (*ERROR, *comparison(scenario), *DRIVES)
        assert {column.metric for column in columns} == {*scenario.outcomes[0].means}
        assert [c.heading for c in columns if "[" not in c.heading and "probability" not in c.heading] == [
            "cost",
            "return",
        ]
        assert [text for _, text in next(rows)] == ["controller", *(column.heading for column in columns)]
        ranked = sorted(scenario.outcomes, key=lambda outcome: outcome.means["rmse_mm"].mean)
        for outcome in ranked:
            (name, text), *cells = next(rows)
            assert text == name
            assert str(name).startswith(outcome.controller.name)
            for (value, text), column in zip(cells, columns, strict=True):
                estimate = column.estimate(outcome)
                assert value == ("" if estimate is None else repr(estimate.mean))
                assert text == column.text(estimate).replace(" ", "", 1)


def test_pictures_are_the_results(made: Made) -> None:
    for scenario in made.benchmark.scenarios:
        style = styles_of(made.benchmark.controllers)
        boxes, points = errors(scenario, style), pareto(scenario, style)
        for i, column in enumerate(DISTRIBUTIONS):
            chosen = boxes.layout.updatemenus[0].buttons[i].args[0]["x"]
            for values, box, outcome in zip(chosen, boxes.data, scenario.outcomes[::-1], strict=True):
                np.testing.assert_allclose(values, outcome.sample.metric(column.metric).ravel(), rtol=1e-6)
                assert i or np.array_equal(box.x, values)
        for point, outcome in zip(points.data, scenario.outcomes, strict=True):
            error = outcome.means["rmse_mm"]
            assert point.y == (error.mean,)
            low, high = error.ci95 or (error.mean, error.mean)
            assert (point.y[0] - point.error_y.arrayminus[0], point.y[0] + point.error_y.array[0]) == pytest.approx(
                (low, high)
            )


def test_at_first_the_reference_the_best_and_one_s_own_are_drawn_over_all_the_time() -> None:
    who = [Controller(name, "measured", "", (0,)) for name in ("agent", "worse")]
    who += [Controller(name, "measured", "", own=name == "mine") for name in ("paper", "lqg", "pid", "mine")]
    drawn = frame(who, ["lqg", "agent"], styles_of(who), 10800.0)
    seen = {each.legendgroup for each in drawn.data if each.visible is True}
    assert [who[int(group)].name for group in sorted(seen)] == ["agent", "paper", "lqg", "mine"]
    assert drawn.layout.xaxis.range[1] % 20.0 == 0.0
    assert drawn.layout.xaxis.nticks == 10, "plotly then writes a number every 20 min, the last one too"


def test_numbers_at_a_logarithmic_axis_are_plotly_s_own(made: Made) -> None:
    """With a step or a format of ours, plotly neither leaves some out nor makes them small: they collide on a phone."""
    for picture in made.data["scenarios"][0]["pictures"]:
        axes = [axis for axis in picture["layout"].values() if isinstance(axis, dict) and axis.get("type") == "log"]
        assert axes
        assert not any({"dtick", "tickformat", "tickvals"} & set(axis) for axis in axes)


def test_lines_are_the_rollouts_to_half_a_resolution(made: Made) -> None:
    half = {panel.title: panel.resolution / 2 * (1 + 1e-6) for panel in PANELS}
    for (name, who), run in made.runs.items():
        signals = run.episode(0)
        place = [who for scenario, who in made.runs if scenario == name].index(who)
        told = made.crystals[ROWS.index(name)][0]
        found = unpack(told["packed"][place], OWN)
        wanted = {
            "crystal radius": signals.r_c * 1e3, "radius error": (signals.r_c - signals.r_ref) * 1e3,
            "pull speed": signals.v_p * 6e4, "growth rate": signals.v_g * 6e4, "heater power": signals.Q_H / 1e3,
            "heater temperature": signals.T_1, "melt temperature": signals.T_b, "meniscus height": signals.h_c * 1e3,
            "growth angle": signals.alpha_c * 180 / np.pi,
        }  # fmt: skip
        for title, values in wanted.items():
            np.testing.assert_allclose(found[title, "true"], values, rtol=0, atol=half[title])
        ring = "bright ring less radius"
        read = (signals.r_br_measured - signals.r_br) * 1e3
        np.testing.assert_allclose(found[ring, "camera"] - found[ring, "true"], read, atol=1e-3)
        for title, power in (("pull speed", signals.v_p * 6e4), ("heater power", signals.Q_H / 1e3)):
            mean = [power[max(k - 59, 0) : k + 1].mean() for k in range(len(power))]
            np.testing.assert_allclose(found[title, "mean"], mean, rtol=0, atol=half[title])
        shared = unpack(told["packed"][-1], SHARED)
        for line, values in (
            (("crystal radius", "reference"), signals.r_ref * 1e3), (("heater temperature", "recipe"), signals.T_1_ref),
            ((ring, "hidden offset"), signals.ring_offset * 1e3),
        ):  # fmt: skip
            np.testing.assert_allclose(shared[line][: len(values)], values, rtol=0, atol=half[line[0]])
        assert (", lost" in told["names"][place]) == bool(run.failed[0])
    assert len({*found, *shared}) == len(OWN) + len(SHARED)


def test_the_camera_reading_is_what_the_controller_gets(made: Made) -> None:
    """The environment's own observation, which is less the operator's bias and the reference, is the oracle."""
    told = made.crystals[0][0]
    camera = unpack(told["packed"][0], OWN)["radius error", "camera"]
    env = CzEnv("puller")
    env.reset(seed=int(told["seed"].replace(",", "")))
    scale = scales(MEASURED, make_config().parameters.v_0)[0]
    for k in range(200):
        observation, *_ = env.step(np.zeros(2, np.float32))
        assert camera[k] == pytest.approx(1e3 * observation[0] * scale, abs=2e-3)


def test_a_controller_that_met_fewer_crystals_has_none_to_draw(made: Made) -> None:
    assert [told["seed"] for told in made.crystals[0]] == ["2,000,000", "2,000,001", "2,000,002"]
    assert [text is None for text in made.crystals[0][-1]["packed"]] == [False, False, True, False]
    assert made.crystals[0][-1]["names"][-1].endswith(": not run")


def test_a_signal_that_is_no_number_ends_the_line(made: Made) -> None:
    scenario = made.benchmark.scenarios[1]
    first, *others = scenario.outcomes
    r_br = first.sample.example.r_br.copy()
    r_br[100:] = np.nan
    sample = replace(first.sample, examples=(first.sample.example._replace(r_br=r_br),))
    found = crystals(replace(scenario, outcomes=(replace(first, sample=sample), *others)))[0]
    assert [len(unpack(text, OWN)["growth rate", "true"]) for text in found["packed"][:-1]] == [100, 2160, 2160]


def test_lost_crystals_do_not_set_the_scale(made: Made) -> None:
    told = made.crystals[0][0]
    assert ", lost" in told["names"][0]
    low, high = told["ranges"][0]
    for name, text in zip(told["names"], told["packed"], strict=False):
        radius = unpack(text, OWN)["crystal radius", "true"]
        assert (np.mean((low <= radius) & (radius <= high)) > 0.99) == (", lost" not in name)


@given(st.lists(st.lists(st.integers(-(2**29), 2**29), min_size=3, max_size=3), min_size=1, max_size=4))
def test_packing_loses_nothing(rows: list[list[int]]) -> None:
    text = pack([(0, np.array(row) * PANELS[0].resolution) for row in rows])
    np.testing.assert_array_equal(whole_numbers(text, len(rows)), rows)


@given(st.text())
def test_no_text_ends_the_script_it_is_in(text: str) -> None:
    """An HTML parser sees one script and finds the text in it unchanged; plotly sees no markup of its own."""
    parts = Parts(f'<script id="data">{embedded([text])}</script>')
    assert [tag for tag, _ in parts.elements] == ["script"]
    assert json.loads(parts.texts["data"]) == [text]
    assert not re.search(r"[<>\x00-\x1f\x7f-\x9f]|&(?!amp;|lt;|gt;)", plain(text))


def test_a_name_that_is_markup_stays_text(made: Made) -> None:
    tags = [tag for tag, _ in made.parts.elements]
    assert tags.count("script") == 3
    assert "img" not in tags
    assert "<img" not in made.text.replace(made.parts.texts["1"], "")
    assert EVIL in [text for row in made.parts.rows for _, text in row]
    drawn = [trace["name"] for picture in made.data["scenarios"][0]["pictures"] for trace in picture["data"]]
    assert plain(EVIL) in drawn
    assert not [name for name in [*drawn, *made.crystals[0][0]["names"]] if "<" in name]


def test_nothing_is_fetched_and_no_script_writes_markup(made: Made) -> None:
    """No address in the page but plotly's own, no element that loads, and a policy that forbids it all the same."""
    own = made.text.replace(made.parts.texts["1"], "")
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", own.replace(EVIL, ""))
    for tag, attributes in made.parts.elements:
        assert "src" not in attributes
        assert tag not in ("iframe", "object", "embed", "img")
        assert attributes.get("href", "#").startswith(("#", "data:"))
    policies = [a["content"] for tag, a in made.parts.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    assert policies[0].startswith("default-src 'none'; ")
    assert "connect-src" not in policies[0]
    writes = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function"
    assert not re.search(writes, _asset("page.js"))


def test_the_same_results_give_the_same_bytes(made: Made) -> None:
    assert page(made.benchmark).encode() == made.text.encode()


def test_without_the_reference_there_is_no_comparison() -> None:
    alone = Benchmark((scenario_of("reference-b", ("open-loop",), "some")[0],), "", ())
    assert comparison(alone.scenarios[0]) == ()
    assert len(Parts(page(alone)).rows[0]) == 1 + len(ERROR) + len(DRIVES)


def test_json_alone_needs_no_plotly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    arguments = ["--scenarios", "reference-b", "--controllers", "open-loop", "--quiet"]
    assert benchmark.main([*arguments, "--json", str(tmp_path / "lone.json")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["lone.json"]
