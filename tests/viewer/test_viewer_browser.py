"""The page in a real browser: what a person would see and do. Skipped where there is none."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from browser import drivers, opened
from viewer_scene import FRAMES, write_run

pytest.importorskip("viser", reason="the viewer's extra is not installed")
selenium = pytest.importorskip("selenium", reason="no selenium to drive a browser with")

from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

from gsfluent.results.frames import frame_path  # noqa: E402
from gsfluent.viewer.app import App  # noqa: E402
from gsfluent.viewer.model.source import RunSource  # noqa: E402


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[App, Any]]:
    drivers()  # before anything is served
    out = write_run(tmp_path_factory.mktemp("run") / "ball")
    # after the last frame a damaged one
    frame_path(out / "stages" / "simulate", FRAMES).write_bytes(b"cut short")
    app = App(RunSource(out), torch.device("cpu"), port=0)
    try:
        with opened(app.url, tmp_path_factory.mktemp("profile")) as chrome:
            yield app, chrome
    finally:
        app.close()


def canvas(chrome: Any) -> np.ndarray:
    """What is seen between the panels, [H, W, 3] in 0..255."""
    from PIL import Image

    shown = np.asarray(Image.open(io.BytesIO(chrome.get_screenshot_as_png())).convert("RGB"))
    places = [c.rect for c in chrome.find_elements(By.TAG_NAME, "canvas")]
    place = max(places, key=lambda r: r["width"] * r["height"])
    left, top = round(place["x"]), round(place["y"])
    # the notice that WebGL runs in software lies over the top of the picture
    top += 170
    return shown[top : round(place["y"] + place["height"]), left : left + round(place["width"])]


def until(chrome: Any, good: Any, seconds: float = 15.0) -> np.ndarray:
    """The first picture for which ``good`` holds; fails when none comes."""
    end = time.monotonic() + seconds
    while True:
        picture = canvas(chrome)
        if good(picture):
            return picture
        assert time.monotonic() < end, "the picture did not come"
        time.sleep(0.2)


def greens(picture: np.ndarray) -> int:
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return int(((g > r + 25) & (g > b + 25)).sum())


def reds(picture: np.ndarray) -> int:
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return int(((r > g + 50) & (r > b + 50)).sum())


def control(chrome: Any, label: str) -> Any:
    """The slider beside a label."""
    path = f"//*[normalize-space(text())='{label}']/following::*[@role='slider'][1]"
    return chrome.find_element(By.XPATH, path)


def test_a_person_sees_the_object_and_what_each_control_does(page: tuple[App, Any]) -> None:
    app, chrome = page
    app.show(0)
    whole = until(chrome, lambda p: greens(p) > 5000)
    # a green ball whose red inside nobody sees yet
    assert reds(whole) < 0.01 * greens(whole)

    slider = control(chrome, "Frame")
    for _ in range(FRAMES - 1):
        slider.send_keys(Keys.ARROW_RIGHT)
    parted = until(chrome, lambda p: reds(p) > 1000)
    assert app.index == FRAMES - 1
    assert "2 pieces" in chrome.page_source

    before = until(chrome, lambda p: app.wait_idle(0.1))
    control(chrome, "Around").send_keys(Keys.HOME)
    until(chrome, lambda p: np.abs(p.astype(int) - before).mean() > 1.0)
    assert abs(app.look.light.lamps[0].direction[1]) < 1e-6  # -180 degrees: along x

    chrome.find_element(By.CSS_SELECTOR, 'input[value="Appearance"]').click()
    option = "//*[@role='option'][normalize-space(.)='Fragment']"
    chrome.find_element(By.XPATH, option).click()
    pieces = until(chrome, lambda p: greens(p) < 0.1 * greens(parted))
    r, _, b = pieces.astype(int).transpose(2, 0, 1)
    assert int((b > r + 40).sum()) > 1000  # the first piece is blue, the second orange
    assert int((r > b + 60).sum()) > 1000
    assert "Fragments: 2" in chrome.page_source

    slider.send_keys(Keys.ARROW_RIGHT)
    kept = until(chrome, lambda p: "cannot be shown" in chrome.page_source)
    assert f"frame_000{FRAMES + 1}.npz" in chrome.page_source
    assert np.abs(kept.astype(int) - pieces).mean() < 1.0  # the last good picture stays
    slider.send_keys(Keys.HOME)
    until(chrome, lambda p: "cannot be shown" not in chrome.page_source)
