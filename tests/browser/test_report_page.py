"""``report.html`` in Chromium without a window: ``make test-browser``. Skipped where chromium, chromedriver or selenium
is absent."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cz_gym.evaluation.report.page_signals import OWN, PANELS, SHARED

from cz_gym.evaluation.report.page import page
from cz_gym.evaluation.results import Benchmark
from tests.samples import scenario_of

selenium = pytest.importorskip("selenium", reason="selenium is absent: pip install '.[browser]'")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import Select, WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is absent: apt-get install chromium"),
    pytest.mark.skipif(DRIVER is None, reason="chromedriver is absent: apt-get install chromium-driver"),
]
EVIL = "</script><img src=x onerror=document.title='evil'>\"'&amp;<b>%{x}<a href=\"javascript:alert(1)\">a</a>"
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
    "--disable-component-update",
)  # fmt: skip
RANGES = (
    "return Object.entries(document.getElementById('signals')._fullLayout)"
    ".filter(([key]) => /^xaxis\\d*$/.test(key)).map(([, axis]) => axis.range)"
)
"""Times that the panels show [min]."""
LINES = "return document.getElementById('signals').data.map(t => [t.name, t.yaxis, Array.from(t.y)])"


@pytest.fixture(scope="module")
def made() -> Benchmark:
    """Two controllers and an agent with a name that is markup."""
    names = ("open-loop", "paper", "industrial")
    return Benchmark(tuple(scenario_of(name, names, EVIL)[0] for name in ("puller", "reference-b")), "benchmark.py", ())


@pytest.fixture(scope="module")
def browser(made: Benchmark, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Chromium with the page open, its first crystal drawn."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(made), "utf-8")
    os.environ["SE_OFFLINE"] = "true"
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM or ""
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        resize(driver, 1366)
        driver.get(Path(path).as_uri())
        until(driver, lambda: lines(driver))
        yield driver
    finally:
        driver.quit()


def resize(driver: Any, width: int) -> None:
    size = {"width": width, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def until(driver: Any, holds: Callable[[], Any]) -> Any:
    """What ``holds`` returns once it is true."""
    return WebDriverWait(driver, 60.0, 0.05).until(lambda _: holds())


def lines(driver: Any) -> list[tuple[str, str, list[float]]]:
    """Name, axis and values of every line of the crystal; none before it is drawn."""
    drawn = driver.execute_script("return Boolean(document.getElementById('signals').data)")
    return driver.execute_script(LINES) if drawn else []


def names(driver: Any) -> list[str]:
    """Controllers of the table from top to bottom."""
    rows = driver.find_elements("css selector", ".metrics tbody th")
    return [cell.get_attribute("data-value") for cell in rows if cell.is_displayed()]


def choose(driver: Any, what: str, choice: str) -> None:
    Select(driver.find_element("id", what)).select_by_visible_text(choice)


def test_it_opens_from_disk_without_a_complaint_and_fetches_nothing(browser: Any) -> None:
    assert browser.current_url.startswith("file://")
    sent = [json.loads(line["message"])["message"] for line in browser.get_log("performance")]
    addresses = {
        message["params"]["request"]["url"] for message in sent if message["method"] == "Network.requestWillBeSent"
    }
    # Chromium's own new-tab page, left behind when ours opens, loads parts of the browser itself.
    allowed = ("data:", "blob:", "file:", "chrome:", "chrome-untrusted:")
    assert {address for address in addresses if not address.startswith(allowed)} == set()
    assert len([address for address in addresses if address.startswith("file:")]) == 1
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0


def test_the_first_line_is_the_verdict_and_names_are_text(browser: Any) -> None:
    assert browser.find_element("tag name", "body").text.startswith("No verdict: ")
    assert browser.title == "Cz-v0 benchmark"
    assert EVIL in names(browser)
    assert browser.find_elements("css selector", "img, svg a") == []
    legend = browser.execute_script("return [...document.querySelectorAll('.legendtext')].map(t => t.textContent)")
    assert any(name.startswith("</script><img src=x") for name in legend)


def test_a_click_sorts_the_table_and_a_key_turns_it_round(made: Benchmark, browser: Any) -> None:
    outcomes = made.scenarios[0].outcomes
    means = {each.controller.name: each.means["pull_step_rms_mm_per_min"].mean for each in outcomes}
    ranked = sorted(means, key=lambda name: means[name])
    buttons = browser.find_elements("css selector", ".metrics thead th button")
    button = next(one for one in buttons if one.text.startswith("pull step RMS [mm/min]"))
    button.click()
    assert names(browser) == ranked
    button.send_keys(Keys.ENTER)
    assert names(browser) == ranked[::-1]
    assert button.find_element("xpath", "..").get_attribute("aria-sort") == "descending"


def test_lines_are_those_of_the_chosen_crystal(made: Benchmark, browser: Any) -> None:
    data = json.loads(browser.execute_script("return document.getElementById('data').textContent"))
    told = data["scenarios"][0]["crystals"][1]["names"]
    choose(browser, "seed", "2,000,001")
    until(browser, lambda: lines(browser)[0][0] == told[0])
    assert len(lines(browser)) == 3 * len(OWN) + len(SHARED)
    for place, outcome in enumerate(made.scenarios[0].outcomes):
        signals = outcome.sample.examples[1]
        radius, speed = (lines(browser)[place * len(OWN) + own(title)] for title in ("crystal radius", "pull speed"))
        assert radius[0] == told[place]
        np.testing.assert_allclose(radius[2], signals.r_c * 1e3, atol=5.1e-4)
        np.testing.assert_allclose(speed[2], signals.v_p * 6e4, atol=2.6e-4)


def own(title: str) -> int:
    """Place of a panel's true values among a controller's lines."""
    return next(i for i, (panel, name) in enumerate(OWN) if (PANELS[panel].title, name) == (title, "true"))


def test_zoom_is_linked_and_outlives_another_crystal(browser: Any) -> None:
    """A drag in one panel zooms the time of all of them, a double click shows all of it again."""
    from selenium.webdriver.common.action_chains import ActionChains

    assert browser.execute_script(RANGES) == [[0, 180]] * len(PANELS)
    pane = browser.find_element("css selector", "#signals .draglayer .xy .nsewdrag")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", pane)
    quarter = int(pane.rect["width"] / 4)
    drag = ActionChains(browser).move_to_element_with_offset(pane, -quarter, 0)
    drag.click_and_hold().move_by_offset(quarter, 0).release().perform()
    until(browser, lambda: browser.execute_script(RANGES)[0] != [0, 180])
    zoomed = browser.execute_script(RANGES)
    assert zoomed == [zoomed[0]] * len(PANELS)
    assert zoomed[0] == pytest.approx([45, 90], abs=1)
    before = lines(browser)[0]
    choose(browser, "seed", "2,000,002")
    until(browser, lambda: lines(browser)[0] != before)
    assert browser.execute_script(RANGES) == zoomed
    ActionChains(browser).double_click(pane).perform()
    until(browser, lambda: browser.execute_script(RANGES) == [[0, 180]] * len(PANELS))


def test_another_scenario_changes_every_part(made: Benchmark, browser: Any) -> None:
    choose(browser, "scenario", "reference-b")
    until(browser, lambda: len(browser.find_elements("css selector", "#seed option")) == 1)
    assert "reference-b" in browser.find_elements("css selector", ".scenario .note")[1].text
    rmse = made.scenarios[1].outcomes[1].means["rmse_mm"].mean
    points, boxes = (
        browser.execute_script(f"return document.getElementById('picture-{i}')._fullData.map(t => [...t.{axis}])")
        for i, axis in enumerate("yx")
    )
    assert points[1] == [pytest.approx(rmse, rel=1e-5)]
    assert boxes[1] == [pytest.approx(rmse, rel=1e-5)]
    largest = made.scenarios[1].outcomes[1].means["max_error_mm"].mean
    pressed = (
        "const b = document.getElementById('picture-1'); Plotly.update(b, ...b.layout.updatemenus[0].buttons[2].args)"
    )
    browser.execute_script(pressed)
    found = "return document.getElementById('picture-1')._fullData[1].x"
    until(browser, lambda: list(browser.execute_script(found)) == [pytest.approx(largest, rel=1e-5)])


@pytest.mark.parametrize("width", [1366, 400])
def test_no_window_needs_sideways_scrolling(browser: Any, width: int) -> None:
    """Only a table may be wider than the window, inside its own frame."""
    resize(browser, width)
    until(browser, lambda: browser.execute_script("return window.innerWidth") == width)
    until(browser, lambda: browser.execute_script("return document.documentElement.scrollWidth <= window.innerWidth"))


def test_a_narrow_window_has_one_column_and_nothing_covers_anything(browser: Any) -> None:
    """Pictures below each other, inside the window, titles clear of the menu."""
    resize(browser, 400)

    def box(selector: str) -> dict[str, float]:
        script = "return document.querySelector(arguments[0]).getBoundingClientRect().toJSON()"
        return dict(browser.execute_script(script, selector))

    until(browser, lambda: box("#signals svg")["right"] <= 400)
    upper, lower = box("#picture-0"), box("#picture-1")
    assert lower["top"] >= upper["bottom"]
    for part in ("#picture-0", "#picture-1", "#signals"):
        assert box(f"{part} svg")["right"] <= 400
        assert box(f"{part} .nsewdrag")["width"] > 100
    for title in ("#picture-0 .gtitle", "#picture-1 .gtitle"):
        assert box(title)["right"] <= 400
    assert box("#picture-1 .gtitle")["right"] <= box("#picture-1 .updatemenu-header")["left"]
    assert box("#picture-0 .nsewdrag")["height"] > 150
    for part in ("#picture-0", "#picture-1"):
        labels = browser.find_elements("css selector", f"{part} .xtick text")
        ends = sorted((label.rect["x"], label.rect["x"] + label.rect["width"]) for label in labels)
        assert all(right <= left for (_, right), (left, _) in pairwise(ends)), "numbers at an axis collide"


def test_no_complaint_at_the_end_either(browser: Any) -> None:
    assert [line for line in browser.get_log("browser") if line["level"] != "INFO"] == []
    assert browser.find_element("id", "trouble").is_displayed() is False
