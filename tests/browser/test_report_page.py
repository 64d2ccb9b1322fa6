"""``report.html`` in Chromium without a window: ``make test-browser``. Skipped where chromium, chromedriver or selenium
is absent."""

import json
from itertools import pairwise
from pathlib import Path

import pytest

from cz_gym.tools.report.page import page
from tests.browser.chromium import chromium, pytestmark, resize, until  # noqa: F401
from tests.samples import joined, result_of

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
def browser(made, tmp_path_factory):
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


def test_the_page_opens_from_disk_without_an_error_and_fetches_nothing(browser):
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


def test_text_is_painted_before_a_picture_is_drawn(browser):
    script = "return performance.getEntriesByName(arguments[0])[0].startTime"
    assert browser.execute_script(script, "first-contentful-paint") < browser.execute_script(script, "picture")


def test_the_first_line_is_the_verdict_and_names_are_text(browser):
    assert browser.find_element("tag name", "body").text.startswith("No verdict: ")
    assert browser.title == "Cz-v0 benchmark"
    assert EVIL in [cell.text for cell in browser.find_elements("css selector", "details[open] tbody th")]
    assert browser.find_elements("css selector", "img, svg a") == []
    legend = browser.execute_script("return [...document.querySelectorAll('.legendtext')].map(t => t.textContent)")
    assert any(name.startswith("</script><img src=x") for name in legend)


@pytest.mark.parametrize("width", [1280, 400])
def test_no_window_needs_sideways_scrolling_and_nothing_covers_anything(browser, width):
    """Only a table may be wider than the window, inside its own frame."""
    resize(browser, width)
    until(browser, lambda: browser.execute_script("return window.innerWidth") == width)
    until(browser, lambda: browser.execute_script("return document.documentElement.scrollWidth <= window.innerWidth"))

    def box(selector):
        script = "return document.querySelector(arguments[0]).getBoundingClientRect().toJSON()"
        return dict(browser.execute_script(script, selector))

    until(browser, lambda: box("#crystal svg")["right"] <= width)
    boxes = [box(f"#{picture}") for picture in PICTURES]
    assert all(lower["top"] >= upper["bottom"] for upper, lower in pairwise(boxes))
    for picture in PICTURES:
        assert box(f"#{picture} svg")["right"] <= width
        assert box(f"#{picture} .nsewdrag")["width"] > 100
        assert box(f"#{picture} .updatemenu-header")["bottom"] <= box(f"#{picture} .nsewdrag")["top"]
    assert box("#crystal .updatemenu-header")["bottom"] <= box("#crystal .annotation")["top"]
    assert box("#crystal .legend")["bottom"] <= boxes[1]["bottom"]
    labels = browser.find_elements("css selector", "#pareto .xtick text")
    ends = sorted((label.rect["x"], label.rect["x"] + label.rect["width"]) for label in labels)
    assert all(right <= left for (_, right), (left, _) in pairwise(ends)), "numbers at an axis collide"


def test_the_browser_logged_no_error(browser):
    assert [line for line in browser.get_log("browser") if line["level"] != "INFO"] == []
