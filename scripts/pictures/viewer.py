"""Screenshots of the viewer for the documentation, taken in a headless chromium."""

from __future__ import annotations

import argparse
import io
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent.viewer.app import App
from gsfluent.viewer.model.source import RunSource

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
ROOT = Path(__file__).resolve().parents[2]


class Page:
    """The viewer's page as a person handles it."""

    def __init__(self, app: App, size: tuple[int, int], profile: str) -> None:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = shutil.which("chromium") or ""
        window = f"--window-size={size[0]},{size[1]}"
        for flag in (*FLAGS, window, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        driver = Service(shutil.which("chromedriver") or "")
        self.app = app
        self.chrome = webdriver.Chrome(options=options, service=driver)
        self.chrome.get(app.url)
        self.settle()
        for cross in self.chrome.find_elements("css selector", "[class*=Notification-close]"):
            cross.click()
        self.settle()

    def settle(self) -> None:
        """Wait until the picture is sharp and on the page."""
        while not self.app.server.get_clients():
            time.sleep(0.1)
        time.sleep(0.5)
        if not self.app.wait_idle(60.0):
            sys.exit("the picture did not come within a minute")
        time.sleep(1.0)

    def find(self, path: str) -> Any:
        """The element at an XPath."""
        return self.chrome.find_element("xpath", path)

    def choose(self, label: str, option: str) -> None:
        """Pick from a drop-down."""
        self.find(f"//*[normalize-space(text())='{label}']/following::input[1]").click()
        self.find(f"//*[@role='option'][normalize-space(.)='{option}']").click()

    def click(self, text: str) -> None:
        """Click on what says ``text``."""
        self.find(f"//*[normalize-space(text())='{text}']").click()

    def check(self, label: str) -> None:
        """Toggle a checkbox."""
        path = f"//*[normalize-space(text())='{label}']/following::input[@type='checkbox'][1]"
        self.chrome.execute_script("arguments[0].click()", self.find(path))

    def slide(self, label: str, key: str, times: int) -> None:
        """Move a slider with the keyboard."""
        path = f"//*[normalize-space(text())='{label}']/following::*[@role='slider'][1]"
        for _ in range(times):
            self.find(path).send_keys(key)

    def save(self, path: Path) -> None:
        """Write what is seen as JPEG."""
        from PIL import Image

        self.settle()
        shown = Image.open(io.BytesIO(self.chrome.get_screenshot_as_png())).convert("RGB")
        path.parent.mkdir(parents=True, exist_ok=True)
        shown.save(path, quality=86)
        print(f"{path} {shown.width} x {shown.height}, {path.stat().st_size // 1000} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of a finished run")
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument("--frame", type=int, help="frame shown; the most telling one by default")
    parser.add_argument("--size", type=int, nargs=2, default=(1440, 960), help="of the window [px]")
    arguments = parser.parse_args()
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        sys.exit("chromium and chromedriver are needed")
    app = App(RunSource(arguments.out), torch.device("cpu"), port=0)
    if arguments.frame is not None:
        app.show(arguments.frame)
    with tempfile.TemporaryDirectory() as profile:
        page = Page(app, tuple(arguments.size), profile)
        try:
            page.save(arguments.to / "viewer.jpg")
            page.choose("By", "Fragment")
            page.save(arguments.to / "viewer_fragments.jpg")
            page.choose("By", "Appearance")
            page.click("Time")
            page.click("Light")
            page.click("Cut plane")
            page.check("Cut open")
            page.save(arguments.to / "viewer_cut.jpg")
        finally:
            page.chrome.quit()
            app.close()


if __name__ == "__main__":
    main()
