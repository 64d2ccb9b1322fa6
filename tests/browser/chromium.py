"""Chromium without a window; skipped where chromium, chromedriver or selenium is absent."""

import os
import shutil
from contextlib import contextmanager

import pytest

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
