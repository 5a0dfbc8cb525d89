"""Chromium without a screen, for tests of pages; they are skipped where it is not installed."""

import contextlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium.webdriver import Chrome

DEADLINE_S = 90.0


@contextlib.contextmanager
def browser(profile: Path, *flags: str) -> Iterator[Chrome]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("Debian's packages chromium and chromium-driver are not installed")
    from selenium import webdriver  # noqa: PLC0415 - only where there is a browser

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    quiet = ("disable-quic", "no-first-run", "disable-background-networking", "disable-component-update")
    for flag in ("headless", "no-sandbox", "disable-gpu", "disable-sync", *quiet, f"user-data-dir={profile}", *flags):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        yield chrome
    finally:
        chrome.quit()


def size(chrome: Chrome, width: int, height: int) -> None:
    """Give the page a window of this size, as a phone's below 500."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def wait(chrome: Chrome, condition: str, deadline_s: float = DEADLINE_S) -> Any:
    ends = time.monotonic() + deadline_s
    while not (value := chrome.execute_script(f"return {condition}")):
        assert time.monotonic() < ends, f"never true in the page: {condition}"
        time.sleep(0.05)  # the page is another program: there is nothing to wait on
    return value


def console(chrome: Chrome) -> list[str]:
    return [entry["message"] for entry in chrome.get_log("browser")]


def requested(chrome: Chrome) -> set[str]:
    messages = [json.loads(entry["message"])["message"] for entry in chrome.get_log("performance")]
    return {one["params"]["request"]["url"] for one in messages if one["method"] == "Network.requestWillBeSent"}


def wait_for(condition: Callable[[], bool], deadline_s: float = DEADLINE_S) -> None:
    ends = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.02)  # as above
