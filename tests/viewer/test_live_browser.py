"""Poking in a real browser: press a button, see the object break. Skipped where there is none."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from browser import drivers, opened
from live_ball import ball

from gsfluent.io import save_solid

pytest.importorskip("viser", reason="the viewer's extra is not installed")
pytest.importorskip("selenium", reason="no selenium to drive a browser with")

from selenium.webdriver.common.by import By
from test_viewer_browser import greens, reds, until

from gsfluent.live.player import AT_REST, RUNNING, LivePlayer
from gsfluent.live.scene import open_stage
from gsfluent.live.session import LiveSession
from gsfluent.viewer.app import App
from gsfluent.viewer.model.live_source import LiveSource
from gsfluent.viewer.panels.poke import PokePanel


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LivePlayer, App, Any]]:
    drivers()  # before anything is served
    home = tmp_path_factory.mktemp("live")
    save_solid(ball(), home / "ball.ply")
    stage = open_stage(home / "ball.ply", material="fruit.watermelon")
    session = LiveSession(stage.scene, dx=0.025, slow=4.0)
    player = LivePlayer(session, stage.shot)
    panel = PokePanel(player, home)
    app = App(LiveSource(player, "ball", stage.shot), torch.device("cpu"), port=0, panels=[panel])
    player.start()
    panel.start()
    try:
        with opened(app.url, tmp_path_factory.mktemp("profile")) as chrome:
            yield player, app, chrome
    finally:
        panel.close()
        player.close()
        app.close()


def press(chrome: Any, label: str) -> None:
    path = f"//button[normalize-space(.)='{label}']"
    deadline = time.monotonic() + 15.0
    while not (found := chrome.find_elements(By.XPATH, path)):
        assert time.monotonic() < deadline, f"no button {label!r}"
        time.sleep(0.1)
    found[0].click()


def settled(chrome: Any) -> np.ndarray:
    """The picture that stays; the first ones are quick, and their edges and shadows differ."""
    before = np.zeros(0)

    def stays(picture: np.ndarray) -> bool:
        nonlocal before
        same = greens(picture) > 5000 and np.array_equal(picture, before)
        before = picture
        time.sleep(0.0 if same else 1.0)
        return same

    return until(chrome, stays, seconds=60.0)


def test_shoot_breaks_the_object_in_the_picture_and_reset_mends_it(page) -> None:
    player, app, chrome = page
    whole = settled(chrome)
    assert player.status.state == AT_REST and "at rest" in chrome.page_source
    assert reds(whole) < 0.02 * greens(whole)
    press(chrome, "Shoot")
    until(chrome, lambda p: reds(p) > 0.05 * greens(whole), seconds=60.0)
    assert player.status.state == RUNNING
    assert "× real time" in chrome.page_source
    assert player.session.pokes[0]["type"] == "bullet"
    assert app.index > 0
    press(chrome, "Reset")
    until(chrome, lambda p: reds(p) < 0.02 * greens(whole)
          and abs(greens(p) - greens(whole)) < 0.05 * greens(whole), seconds=60.0)  # fmt: skip
