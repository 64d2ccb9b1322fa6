"""The operator's page and ``report.html`` in Chromium without a window: ``make test-browser``. Skipped where chromium,
chromedriver or selenium is absent."""

import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from cz_gym.tools.report.page import page
from tests.samples import joined, result_of
from tests.tools.serve.conftest import PASSWORD, running

selenium = pytest.importorskip("selenium", reason="selenium is absent: pip install '.[browser]'")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
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
        until(driver, lambda: len(driver.find_elements("css selector", "#charts svg")) >= 4)
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
    points = "[...c.querySelectorAll('path')].at(-1).getAttribute('d').split('L').length"
    script = f"return [...document.querySelectorAll('#charts section')].map(c => {points})"
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


@pytest.fixture(scope="module")
def made():
    """Two controllers and an agent with a name that is markup, on two scenarios."""
    names = ("open-loop", "paper", "pid-conventional")
    return joined([result_of(name, names, EVIL)[0] for name in ("puller", "reference-b")])


@pytest.fixture(scope="module")
def report(made, tmp_path_factory):
    """Chromium with the page open."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(made, "benchmark.py"), "utf-8")
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        driver.get(Path(path).as_uri())
        until(driver, lambda: driver.find_elements("css selector", "#right-side .panel"))
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


def test_the_heading_the_plot_and_the_verdict_come_first_and_names_are_text(report):
    begins = "return [...document.querySelector('main').children].slice(0, 3).map(each => each.tagName)"
    assert report.execute_script(begins) == ["H1", "svg", "P"]
    assert report.find_element("id", "verdict").text.startswith("No verdict: ")
    assert report.title == "Cz-v0 benchmark"
    assert EVIL in [cell.text for cell in report.find_elements("css selector", "details[open] tbody th")]
    assert report.find_elements("css selector", "img, svg a") == []
    offered = [each.get_attribute("textContent") for each in report.find_elements("css selector", "#left-name option")]
    assert EVIL in offered
    scale = report.find_elements("css selector", '#left-side .panel text[x="54"]')
    assert "0" in [each.get_attribute("textContent") for each in scale], "a scale without its zero"


@pytest.mark.parametrize("width", [1280, 400])
def test_no_window_needs_sideways_scrolling(report, width):
    """Only a table may be wider than the window, inside its own frame."""
    resize(report, width)
    until(report, lambda: report.execute_script("return window.innerWidth") == width)
    until(report, lambda: report.execute_script("return document.documentElement.scrollWidth <= window.innerWidth"))
    script = "return Math.max(...[...document.querySelectorAll('svg')].map(s => s.getBoundingClientRect().right))"
    assert report.execute_script(script) <= width


def test_the_player_works_by_keyboard(report):
    """A key chooses another controller, and an arrow another time; both are shown."""
    resize(report, 1280)
    menu, time, clock = (report.find_element("id", name) for name in ("right-name", "time", "clock"))
    before = report.find_element("id", "right-side").text
    menu.send_keys("o")
    until(report, lambda: report.find_element("id", "right-side").text != before)
    late, place = clock.text, "#left-side .panel .axis"
    at = report.find_element("css selector", place).get_attribute("d")
    time.send_keys(Keys.HOME)
    until(report, lambda: clock.text == "0 min" != late)
    assert report.find_element("css selector", place).get_attribute("d") != at
    report.find_element("id", "play").send_keys(Keys.ENTER)
    until(report, lambda: clock.text not in ("0 min", late))
    assert report.find_element("id", "play").text == "Pause"
    report.find_element("id", "play").send_keys(Keys.ENTER)


def test_it_is_dark_when_asked_and_prints_whole_tables(report):
    def grounds(**media):
        report.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        script = "return ['body', '.cz .back'].map(n => getComputedStyle(document.querySelector(n)))"
        return report.execute_script(script + ".map((s, n) => n ? s.fill : s.backgroundColor)")

    light = grounds(features=[{"name": "prefers-color-scheme", "value": "light"}])
    dark = grounds(features=[{"name": "prefers-color-scheme", "value": "dark"}])
    assert light == ["rgb(255, 255, 255)"] * 2
    assert dark == ["rgb(13, 17, 23)"] * 2
    resize(report, 1040)  # the width of A4 across
    assert grounds(media="print", features=[]) == light
    script = "return [...document.querySelectorAll('.scroll')].every(s => s.scrollWidth <= s.clientWidth + 1)"
    assert report.execute_script(script), "a table is cut"
    report.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})
    resize(report, 1280)


def test_the_player_prints_on_one_page(report):
    """On A4 across, which holds 277 by 190 mm."""
    report.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print", "features": []})
    resize(report, round(277 / 25.4 * 96))
    top = "[...document.querySelectorAll('h2.pictures')].at(-1).getBoundingClientRect().top"
    tall = report.execute_script(f"return document.getElementById('sides').getBoundingClientRect().bottom - {top}")
    report.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})
    resize(report, 1280)
    assert 0 < tall <= 190 / 25.4 * 96


def test_the_browser_logged_no_error(report):
    assert [line for line in report.get_log("browser") if line["level"] != "INFO"] == []
