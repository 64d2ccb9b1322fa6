"""The operator's page and ``report.html`` in Chromium without a window: ``make test-browser``. Skipped where chromium,
chromedriver or selenium is absent."""

import json
import os
import shutil
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from cz_gym.tools.report.page import page
from tests.samples import joined, result_of
from tests.tools.serve.conftest import PASSWORD, running

selenium = pytest.importorskip("selenium", reason="selenium is absent: pip install '.[browser]'")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is absent: apt-get install chromium"),
    pytest.mark.skipif(DRIVER is None, reason="chromedriver is absent: apt-get install chromium-driver"),
]
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
    "--disable-component-update",
)  # fmt: skip


@contextmanager
def chromium(profile):
    """A browser 1280 px wide."""
    os.environ["SE_OFFLINE"] = "true"
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM or ""
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        resize(driver, 1280)
        yield driver
    finally:
        driver.quit()


def resize(driver, width):
    size = {"width": width, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def until(driver, holds):
    """What ``holds`` returns once it is true."""
    return WebDriverWait(driver, 60.0, 0.05).until(lambda _: holds())


@pytest.fixture(scope="module")
def puller(tmp_path_factory):
    patch = pytest.MonkeyPatch()
    patch.setenv("CZ_GYM_OPERATOR_PASSWORD", PASSWORD)
    with running(tmp_path_factory.mktemp("page"), "--operator", "olga", "--speed", "60", "--scenario", "puller") as one:
        yield one
    patch.undo()


@pytest.fixture(scope="module")
def screen(puller, tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        driver.get(f"http://127.0.0.1:{puller.page}/")
        until(driver, lambda: len(driver.find_elements("css selector", "#charts .main-svg")) >= 4)
        yield driver


def text(driver, name):
    return str(driver.find_element("id", name).text)


def test_it_shows_what_the_tags_say_and_goes_on(puller, screen):
    first = text(screen, "time")
    until(screen, lambda: text(screen, "time") > first)
    until(screen, lambda: "fallback" in text(screen, "alarms"))
    assert (text(screen, "scenario"), text(screen, "state")) == ("puller", "growing")
    rows = [row.text.split() for row in screen.find_elements("css selector", "#values tr")]
    names = [" ".join(row[:2]) for row in rows[1:]]
    assert names == ["ring radius", "pull speed", "heater power", "heater T_1"]
    assert float(rows[1][2]) == pytest.approx(101.4, abs=1.0)
    script = "return [...document.querySelectorAll('#charts section')].map(c => c.data[0].x.length)"
    shown = screen.execute_script(script)
    assert len(shown) == 4
    assert min(shown) > 3
    assert screen.execute_script("return document.getElementById('crystal').naturalWidth") == 640


def test_a_guest_cannot_set_drives_and_an_operator_can(puller, screen):
    assert not screen.find_element("id", "hand").is_displayed()
    assert text(screen, "login") == "log in"
    screen.get(f"http://olga:{PASSWORD.replace(' ', '%20')}@127.0.0.1:{puller.page}/login")
    screen.get(f"http://127.0.0.1:{puller.page}/")  # its address must not hold the password
    until(screen, lambda: screen.find_element("id", "hand").is_displayed())
    assert text(screen, "login") == "olga"
    field = screen.find_element("name", "pull_speed_setpoint_mm_per_min")
    field.clear()
    field.send_keys("1.31")
    screen.find_element("css selector", "form button").click()
    until(screen, lambda: puller.machine.control == "manual" and "manual" in text(screen, "alarms"))
    assert text(screen, "answer") == "taken"
    screen.find_element("id", "release").click()
    until(screen, lambda: puller.machine.control != "manual")


@pytest.mark.parametrize("width", [1280, 400])
def test_no_window_of_the_operator_needs_sideways_scrolling(screen, width):
    resize(screen, width)
    until(screen, lambda: screen.execute_script("return window.innerWidth") == width)
    until(screen, lambda: screen.execute_script("return document.documentElement.scrollWidth <= window.innerWidth"))
    image = screen.find_element("id", "crystal").rect
    assert image["width"] / image["height"] == pytest.approx(640 / 480, rel=0.01)


def test_the_operators_page_logs_no_error(screen):
    assert [line for line in screen.get_log("browser") if line["level"] != "INFO"] == []


EVIL = "</script><img src=x onerror=document.title='evil'>\"'&amp;<b>%{x}<a href=\"javascript:alert(1)\">a</a>"
PICTURES = ("pareto", "crystal")
WATCH = """new MutationObserver(() => document.querySelector(".main-svg") && performance.mark("picture"))
    .observe(document, { subtree: true, childList: true });"""
"""Script that notes when there are pictures."""


@pytest.fixture(scope="module")
def made():
    """Two controllers and an agent with a name that is markup, on two scenarios."""
    names = ("open-loop", "paper", "pid-conventional")
    return joined([result_of(name, names, EVIL)[0] for name in ("puller", "reference-b")])


@pytest.fixture(scope="module")
def report(made, tmp_path_factory):
    """Chromium with the page open, its pictures drawn."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(made, "benchmark.py"), "utf-8")
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH})
        driver.get(Path(path).as_uri())
        driver.execute_script("document.getElementById('pareto').scrollIntoView()")
        until(driver, lambda: driver.find_elements("css selector", "#pareto .legendtext"))
        driver.execute_script("document.getElementById('crystal').scrollIntoView()")
        until(driver, lambda: driver.find_elements("css selector", "#crystal .legendtext"))
        yield driver


def test_the_page_opens_from_disk_without_an_error_and_fetches_nothing(report):
    assert report.current_url.startswith("file://")
    sent = [json.loads(line["message"])["message"] for line in report.get_log("performance")]
    addresses = {
        message["params"]["request"]["url"] for message in sent if message["method"] == "Network.requestWillBeSent"
    }
    # Chromium's own new-tab page, left behind when ours opens, loads parts of the browser itself.
    allowed = ("data:", "blob:", "file:", "chrome:", "chrome-untrusted:")
    assert {address for address in addresses if not address.startswith(allowed)} == set()
    assert len([address for address in addresses if address.startswith("file:")]) == 1
    assert report.execute_script("return performance.getEntriesByType('resource').length") == 0


def test_text_is_painted_before_a_picture_is_drawn(report):
    script = "return performance.getEntriesByName(arguments[0])[0].startTime"
    assert report.execute_script(script, "first-contentful-paint") < report.execute_script(script, "picture")


def test_the_first_line_is_the_verdict_and_names_are_text(report):
    assert report.find_element("tag name", "body").text.startswith("No verdict: ")
    assert report.title == "Cz-v0 benchmark"
    assert EVIL in [cell.text for cell in report.find_elements("css selector", "details[open] tbody th")]
    assert report.find_elements("css selector", "img, svg a") == []
    legend = report.execute_script("return [...document.querySelectorAll('.legendtext')].map(t => t.textContent)")
    assert any(name.startswith("</script><img src=x") for name in legend)


@pytest.mark.parametrize("width", [1280, 400])
def test_no_window_needs_sideways_scrolling_and_nothing_covers_anything(report, width):
    """Only a table may be wider than the window, inside its own frame."""
    resize(report, width)
    until(report, lambda: report.execute_script("return window.innerWidth") == width)
    until(report, lambda: report.execute_script("return document.documentElement.scrollWidth <= window.innerWidth"))

    def box(selector):
        script = "return document.querySelector(arguments[0]).getBoundingClientRect().toJSON()"
        return dict(report.execute_script(script, selector))

    until(report, lambda: box("#crystal svg")["right"] <= width)
    boxes = [box(f"#{picture}") for picture in PICTURES]
    assert all(lower["top"] >= upper["bottom"] for upper, lower in pairwise(boxes))
    for picture in PICTURES:
        assert box(f"#{picture} svg")["right"] <= width
        assert box(f"#{picture} .nsewdrag")["width"] > 100
        assert box(f"#{picture} .updatemenu-header")["bottom"] <= box(f"#{picture} .nsewdrag")["top"]
    assert box("#crystal .updatemenu-header")["bottom"] <= box("#crystal .annotation")["top"]
    assert box("#crystal .legend")["bottom"] <= boxes[1]["bottom"]
    labels = report.find_elements("css selector", "#pareto .xtick text")
    ends = sorted((label.rect["x"], label.rect["x"] + label.rect["width"]) for label in labels)
    assert all(right <= left for (_, right), (left, _) in pairwise(ends)), "numbers at an axis collide"


def test_the_browser_logged_no_error(report):
    assert [line for line in report.get_log("browser") if line["level"] != "INFO"] == []
