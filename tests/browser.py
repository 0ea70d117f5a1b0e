"""A real browser for the tests of pages; they are skipped where there is none."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip


def drivers() -> tuple[str, str]:
    """Where chromium and its driver lie; the test is skipped when one is missing."""
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("no chromium and chromedriver on this machine")
    return browser, driver


@contextmanager
def opened(url: str, profile: Path, *, height: int = 640) -> Iterator[Any]:
    """Chromium at a page, with a profile of its own."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="no selenium to drive a browser")
    service = pytest.importorskip("selenium.webdriver.chrome.service")
    browser, driver = drivers()
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in (*_FLAGS, f"--window-size=1000,{height}", f"--user-data-dir={profile}"):
        options.add_argument(flag)
    chrome = webdriver.Chrome(options=options, service=service.Service(driver))
    try:
        chrome.get(url)
        yield chrome
    finally:
        chrome.quit()
