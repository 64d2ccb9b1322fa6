"""The operator's page of a virtual puller in Chromium."""

import pytest

from tests.browser.chromium import chromium, pytestmark, resize, until  # noqa: F401
from tests.tools.serve.conftest import PASSWORD, running


@pytest.fixture(scope="module")
def puller(tmp_path_factory):
    patch = pytest.MonkeyPatch()
    patch.setenv("CZ_GYM_OPERATOR_PASSWORD", PASSWORD)
    with running(tmp_path_factory.mktemp("page"), "--operator", "olga", "--speed", "60", "--scenario", "puller") as one:
        yield one
    patch.undo()


@pytest.fixture(scope="module")
def browser(puller, tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        driver.get(f"http://127.0.0.1:{puller.page}/")
        until(driver, lambda: len(driver.find_elements("css selector", "#charts .main-svg")) >= 4)
        yield driver


def text(driver, name):
    return str(driver.find_element("id", name).text)


def test_it_shows_what_the_tags_say_and_goes_on(puller, browser):
    first = text(browser, "time")
    until(browser, lambda: text(browser, "time") > first)
    until(browser, lambda: "fallback" in text(browser, "alarms"))
    assert (text(browser, "scenario"), text(browser, "state")) == ("puller", "growing")
    rows = [row.text.split() for row in browser.find_elements("css selector", "#values tr")]
    names = [" ".join(row[:2]) for row in rows[1:]]
    assert names == ["ring radius", "pull speed", "heater power", "heater T_1"]
    assert float(rows[1][2]) == pytest.approx(101.4, abs=1.0)
    script = "return [...document.querySelectorAll('#charts section')].map(c => c.data[0].x.length)"
    shown = browser.execute_script(script)
    assert len(shown) == 4
    assert min(shown) > 3
    assert browser.execute_script("return document.getElementById('crystal').naturalWidth") == 640


def test_a_guest_cannot_set_drives_and_an_operator_can(puller, browser):
    assert not browser.find_element("id", "hand").is_displayed()
    assert text(browser, "login") == "log in"
    browser.get(f"http://olga:{PASSWORD.replace(' ', '%20')}@127.0.0.1:{puller.page}/login")
    browser.get(f"http://127.0.0.1:{puller.page}/")  # its address must not hold the password
    until(browser, lambda: browser.find_element("id", "hand").is_displayed())
    assert text(browser, "login") == "olga"
    field = browser.find_element("name", "pull_speed_setpoint_mm_per_min")
    field.clear()
    field.send_keys("1.31")
    browser.find_element("css selector", "form button").click()
    until(browser, lambda: puller.machine.control == "manual" and "manual" in text(browser, "alarms"))
    assert text(browser, "answer") == "taken"
    browser.find_element("id", "release").click()
    until(browser, lambda: puller.machine.control != "manual")


@pytest.mark.parametrize("width", [1280, 400])
def test_no_window_needs_sideways_scrolling(browser, width):
    resize(browser, width)
    until(browser, lambda: browser.execute_script("return window.innerWidth") == width)
    until(browser, lambda: browser.execute_script("return document.documentElement.scrollWidth <= window.innerWidth"))
    image = browser.find_element("id", "crystal").rect
    assert image["width"] / image["height"] == pytest.approx(640 / 480, rel=0.01)


def test_nothing_complains(browser):
    assert [line for line in browser.get_log("browser") if line["level"] != "INFO"] == []
