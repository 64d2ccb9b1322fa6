"""``report.html`` in Chromium without a window: ``make test-browser``. Skipped where chromium, chromedriver or selenium
is absent."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cz_gym.evaluation.protocol import find_row
from cz_gym.evaluation.report.page import page
from cz_gym.evaluation.report.page_signals import CURVES, unpack
from cz_gym.evaluation.results import Benchmark, Controller, Sample, ScenarioResult, summarise
from cz_gym.evaluation.rollout import rollout

selenium = pytest.importorskip("selenium", reason="selenium is absent: pip install 'cz-gym[browser]'")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is absent: apt-get install chromium"),
    pytest.mark.skipif(DRIVER is None, reason="chromedriver is absent: apt-get install chromium-driver"),
]
EVIL = "</script><img src=x onerror=document.title='evil'>\"'&amp;<b>%{x}<a href=\"javascript:alert(1)\">a</a>"
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
    "--disable-component-update", "--window-size=1366,768",
)  # fmt: skip
PATIENCE = 60.0
"""Longest wait for the page [s]."""


def scenario(name: str, episodes: int) -> ScenarioResult:
    """Two controllers and an agent with a name that is markup."""
    from cz_gym.baselines.registry import find_controller

    row = find_row(name)
    config, seeds, samples = row.config(), row.seeds(episodes), []
    for who in ("open-loop", "paper", "industrial"):
        run = rollout(find_controller(who).make(config), config, seeds)
        agent = Controller(EVIL, "measured", f"trained with {EVIL}", (4,)) if who == "industrial" else None
        samples.append(Sample.of(agent or Controller(who, "measured", f"what {who} is"), [run]))
    return summarise(row, samples)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Benchmark, Path]:
    """A small benchmark and its page on disk."""
    done = Benchmark((scenario("puller", 3), scenario("reference-b", 3)), "benchmark.py", ())
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(done), "utf-8")
    return done, path


@pytest.fixture(scope="module")
def browser(made: tuple[Benchmark, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Chromium with the page open, its first crystal drawn."""
    os.environ["SE_OFFLINE"] = "true"
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM or ""
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    size = {"width": 1366, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        driver.get(made[1].as_uri())
        drawn(driver, 1)
        yield driver
    finally:
        driver.quit()


def until(driver: Any, holds: Callable[[], Any]) -> Any:
    """What ``holds`` returns once it is true."""
    from selenium.webdriver.support.ui import WebDriverWait

    return WebDriverWait(driver, PATIENCE, 0.05).until(lambda _: holds())


def drawn(driver: Any, at_least: int) -> int:
    """Wait until the crystal has been drawn that often."""
    count = "return Number(document.getElementById('crystal-plot').dataset.drawn || 0)"
    until(driver, lambda: driver.execute_script(count) >= at_least)
    return int(driver.execute_script(count))


def names(driver: Any) -> list[str]:
    """The table's controllers from top to bottom."""
    return [cell.text for cell in driver.find_elements("css selector", "#metrics tbody th .name")]


def pills(driver: Any) -> list[Any]:
    """The boxes of the controllers."""
    return list(driver.find_elements("css selector", "#controllers .pill"))


def curves(driver: Any) -> list[dict[str, Any]]:
    """Name, axis and length of every trace of the crystal."""
    script = (
        "return document.getElementById('crystal-plot').data.map("
        "t => ({name: t.name, axis: t.xaxis, length: t.x.length, mode: t.mode}))"
    )
    found: list[dict[str, Any]] = driver.execute_script(script)
    return found


def test_it_opens_from_disk_without_a_complaint_and_fetches_nothing(browser: Any) -> None:
    assert browser.current_url.startswith("file://")
    assert [line for line in browser.get_log("browser") if line["level"] != "INFO"] == []
    sent = [json.loads(line["message"])["message"] for line in browser.get_log("performance")]
    addresses = {
        message["params"]["request"]["url"] for message in sent if message["method"] == "Network.requestWillBeSent"
    }
    # Chromium's own new-tab page, left behind when ours opens, loads parts of the browser itself.
    allowed = ("data:", "blob:", "file:", "chrome:", "chrome-untrusted:")
    assert {address for address in addresses if not address.startswith(allowed)} == set()
    assert len([address for address in addresses if address.startswith("file:")]) == 1
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0


def test_the_first_line_is_the_verdict(browser: Any) -> None:
    assert browser.find_element("tag name", "body").text.startswith("The agent </script><img")


def test_a_name_that_is_markup_is_shown_as_text(browser: Any) -> None:
    assert browser.title == "Cz-v0 benchmark"
    assert EVIL in names(browser)
    assert browser.find_elements("tag name", "img") == []
    links = browser.execute_script("return [...document.querySelectorAll('svg a')].length")
    assert links == 0
    drawn_names = browser.execute_script("return [...document.querySelectorAll('.legendtext')].map(t => t.textContent)")
    assert any(name.startswith("</script><img src=x") for name in drawn_names)


def test_nothing_offers_to_send_the_plot_away(browser: Any) -> None:
    titles = browser.execute_script("return [...document.querySelectorAll('.modebar-btn')].map(b => b.dataset.title)")
    assert titles
    assert not [title for title in titles if "share" in title.lower() or "cloud" in title.lower()]


def test_a_click_sorts_the_table_and_a_key_turns_it_round(made: tuple[Benchmark, Path], browser: Any) -> None:
    means = {
        outcome.controller.name: outcome.means["pull_step_rms_mm_per_min"].mean
        for outcome in made[0].scenarios[0].outcomes
    }
    wanted = sorted(means, key=lambda name: means[name])

    def heading() -> Any:
        found = browser.find_elements("css selector", "#metrics thead th[data-column]")
        return next(one for one in found if one.text.startswith("pull step RMS\n"))

    heading().find_element("tag name", "button").click()
    assert heading().get_attribute("aria-sort") == "ascending"
    assert names(browser) == wanted
    assert browser.switch_to.active_element == heading().find_element("tag name", "button")
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    assert heading().get_attribute("aria-sort") == "descending"
    assert names(browser) == wanted[::-1]


def test_the_table_can_hold_every_scenario(browser: Any) -> None:
    browser.find_element("id", "all-scenarios").click()
    assert len(names(browser)) == 6
    browser.find_element("id", "all-scenarios").click()
    assert len(names(browser)) == 3


def test_a_crystal_and_its_controllers_are_chosen(made: tuple[Benchmark, Path], browser: Any) -> None:
    """Another seed, every controller: each has its curves, and they are the simulated ones."""
    before = drawn(browser, 1)
    browser.find_element("id", "next").click()
    before = drawn(browser, before + 1)
    open_loop = pills(browser)[0].find_element("tag name", "input")
    if not open_loop.is_selected():
        pills(browser)[0].click()
        drawn(browser, before + 1)
    radius = [curve for curve in curves(browser) if curve["axis"] == "x" and curve["mode"] == "lines"]
    assert len(radius) == 4
    assert {curve["name"] for curve in radius} >= {"open-loop", "paper", "reference"}
    told = json.loads(browser.execute_script("return document.getElementById('episodes').textContent"))
    packed = told[0][1]["runs"][1]["packed"]
    wanted = dict(zip([c.key for c in CURVES], unpack(packed, [c.resolution for c in CURVES]), strict=True))
    shown = browser.execute_script(
        "return document.getElementById('crystal-plot').data"
        ".filter(t => t.name === 'paper' && t.xaxis !== 'x3' && t.mode === 'lines').map(t => Array.from(t.y))"
    )
    np.testing.assert_allclose(shown[0], wanted["r_c"], rtol=1e-12)
    signals = made[0].scenarios[0].outcomes[1].sample.examples[1]
    np.testing.assert_allclose(shown[0], signals.r_c * 1e3, atol=5.1e-4)
    assert browser.find_element("id", "seed").get_attribute("value") == "1"


def test_what_the_camera_said_can_be_left_out(browser: Any) -> None:
    count = drawn(browser, 1)
    with_camera = [curve for curve in curves(browser) if curve["name"].endswith(", camera")]
    browser.find_element("id", "camera").click()
    drawn(browser, count + 1)
    assert len(with_camera) >= 4
    assert not [curve for curve in curves(browser) if curve["name"].endswith(", camera")]
    browser.find_element("id", "camera").click()
    drawn(browser, count + 2)


def test_zoom_is_linked_and_outlives_another_controller(browser: Any) -> None:
    """A drag in one panel zooms the time of all of them."""
    from selenium.webdriver.common.action_chains import ActionChains

    panels = "return Object.entries(document.getElementById('crystal-plot')._fullLayout)" + (
        ".filter(([key]) => /^xaxis\\d*$/.test(key)).map(([, axis]) => axis.range)"
    )
    assert browser.execute_script(panels) == [[0, 180]] * 10
    browser.execute_script("document.getElementById('crystals').scrollIntoView()")
    pane = browser.find_element("css selector", "#crystal-plot .draglayer .xy .nsewdrag")
    width = pane.rect["width"]
    drag = ActionChains(browser).move_to_element_with_offset(pane, int(-width / 4), 0)
    drag.click_and_hold().move_by_offset(int(width / 4), 0).release().perform()
    until(browser, lambda: browser.execute_script(panels)[0] != [0, 180])
    zoomed = browser.execute_script(panels)
    assert zoomed == [zoomed[0]] * 10
    assert zoomed[0] == pytest.approx([45, 90], abs=1)
    count = drawn(browser, 1)
    pills(browser)[1].click()
    drawn(browser, count + 1)
    assert browser.execute_script(panels) == zoomed
    browser.find_element("id", "whole").click()
    until(browser, lambda: browser.execute_script(panels) == [[0, 180]] * 10)


def test_another_scenario_changes_every_part_by_the_keyboard(made: tuple[Benchmark, Path], browser: Any) -> None:
    count = drawn(browser, 1)
    browser.find_element("css selector", "#scenarios input:checked").send_keys(Keys.ARROW_RIGHT)
    drawn(browser, count + 1)
    assert "reference-b" in browser.find_element("id", "table-note").text
    rmse = made[0].scenarios[1].outcomes[1].means["rmse_mm"].mean
    shown = browser.execute_script(
        "return document.getElementById('pictures-plot').data.filter(t => t.name === 'paper').map(t => [...t.y])"
    )
    assert shown[0] == [pytest.approx(rmse, rel=1e-5)]
    assert len(browser.find_elements("css selector", "#seed option")) == 1


def test_a_laptop_needs_no_sideways_scrolling(browser: Any) -> None:
    """Only the table may be wider than the window, inside its own frame."""
    assert browser.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")


def test_no_complaint_at_the_end_either(browser: Any) -> None:
    assert [line for line in browser.get_log("browser") if line["level"] != "INFO"] == []
    assert browser.find_element("id", "trouble").is_displayed() is False
