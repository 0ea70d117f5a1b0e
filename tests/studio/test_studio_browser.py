"""The studio in a real browser, from a dropped file to an exported result; and its parts alone."""

from __future__ import annotations

import http.client
import io
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import drivers, opened

import gsfluent as gf
from gsfluent.config import load_shot
from gsfluent.errors import InputError
from gsfluent.run import from_input

pytest.importorskip("viser", reason="the viewer's extra is not installed")

from gsfluent.studio.desk import DROP, EVENTS, GUESS, SUGGESTED, THROW, Desk
from gsfluent.studio.job import DONE, FAILED, RUNNING, STOPPED, Job
from gsfluent.studio.serve import Studio


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(from_input.SETTINGS, "fill", {"resolution": 24})
    monkeypatch.setitem(from_input.SETTINGS, "solve", {"cells": 8})
    monkeypatch.setitem(from_input.SETTINGS, "output", {"size": [64, 48], "fps": 5, "seconds": 0.8})


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    gf.save(gf.demo.make_splats("watermelon", spacing=0.008), tmp_path / "melon.ply")
    made = Desk(tmp_path, "cpu", 0)
    yield made
    made.stop()


def until(good: Callable[[], Any], seconds: float = 120.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := good()):
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.2)
    return found


def test_the_desk_writes_the_shot_that_was_chosen(desk: Desk) -> None:
    (desk.folder / "notes.txt").write_text("no object")
    assert desk.objects() == ["melon.ply"]
    for event, wanted in (
        (SUGGESTED, ["Drop"]), (DROP, ["Drop"]), (THROW, ["Drop", "Throw"]),
    ):  # fmt: skip
        shot = load_shot(desk.prepare("melon.ply", GUESS, event, 0.3, 5.0, 0.2))
        assert [type(found).__name__ for found in shot.events] == wanted
        assert shot.size == 0.2 and shot.objects["object"].material == "fruit.watermelon"
    assert event in EVENTS and shot.events[1].velocity == (0.0, 0.0, -5.0)  # type: ignore[union-attr]
    assert load_shot(desk.prepare("melon.ply", "glass", DROP, 0.3, 5.0, 0)).events[0].height == 0.3  # type: ignore[union-attr]
    with pytest.raises(InputError, match="no object is chosen"):
        desk.prepare("", GUESS, DROP, 1, 1, 0)
    with pytest.raises(InputError, match="has not been run"):
        desk.export("melon.ply", "gif")


def test_uploads_stay_in_the_folder(desk: Desk) -> None:
    data = (desk.folder / "melon.ply").read_bytes()
    assert desk.receive("melon.ply", data) == "melon_2.ply"  # nothing is written over
    assert desk.receive("../../evil.ply", data) == "evil.ply"
    assert desk.receive("c:\\x\\.hid$den.ply", data) == "hid_den.ply"
    for name in ("run.sh", "shot.yaml", ".ply", "melon"):
        with pytest.raises(InputError, match="is not an object"):
            desk.receive(name, b"")
    assert {p.name for p in desk.folder.iterdir()} == {
        "melon.ply", "melon_2.ply", "evil.ply", "hid_den.ply",
    }  # fmt: skip
    assert not (desk.folder.parent / "evil.ply").exists()


def test_a_job_is_watched_and_stopped(tmp_path: Path) -> None:
    wrong = Job("plan", ["plan", "none.yaml"], tmp_path)
    until(lambda: wrong.state != RUNNING)
    assert wrong.state == FAILED and any("none.yaml" in line for line in wrong.lines)
    right = Job("words", ["run", "--help"], tmp_path)
    until(lambda: right.state != RUNNING)
    assert right.state == DONE and "shot.yaml" in right.answer
    serving = Job("studio", ["studio", str(tmp_path), "--port", "0", "--no-open"], tmp_path)
    until(lambda: any("Ctrl-C ends" in line for line in serving.lines))
    assert serving.state == RUNNING and serving.progress is None
    serving.stop()
    until(lambda: serving.state != RUNNING)
    assert serving.state == STOPPED and serving.seconds > 0
    serving.lines.append("simulate: 3/12 t = 0.1 s")
    assert serving.progress == ("simulate", 0.25)


def test_only_its_own_page_is_answered(desk: Desk) -> None:
    studio = Studio(desk, torch.device("cpu"), 0)
    try:
        for host, origin, status in (
            (None, None, 200), ("evil.example", None, 403), (None, "http://evil.example", 403),
        ):  # fmt: skip
            asked = http.client.HTTPConnection("127.0.0.1", studio.server.get_port(), timeout=20)
            headers = {"Host": host} if host else {}
            asked.request("GET", "/", headers=headers | ({"Origin": origin} if origin else {}))
            assert asked.getresponse().status == status
            asked.close()
    finally:
        studio.close()


@pytest.fixture
def page(desk: Desk, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Studio, Any]]:
    drivers()  # before anything is served
    studio = Studio(desk, torch.device("cpu"), 0)
    try:
        with opened(studio.url, tmp_path_factory.mktemp("profile"), height=900) as chrome:
            yield studio, chrome
    finally:
        studio.close()


def press(chrome: Any, label: str) -> None:
    path = f"//button[normalize-space(.)='{label}']"
    until(lambda: chrome.find_elements("xpath", path))[0].click()


def choose(chrome: Any, shown: str, wanted: str) -> None:
    until(lambda: chrome.find_elements("css selector", f'input[value="{shown}"]'))[0].click()
    option = f"//*[@role='option'][normalize-space(.)='{wanted}']"
    found = until(lambda: chrome.find_elements("xpath", option))[0]
    chrome.execute_script("arguments[0].scrollIntoView()", found)
    found.click()


def says(chrome: Any, text: str, seconds: float = 240.0) -> None:
    try:
        until(lambda: text in chrome.find_element("tag name", "body").text, seconds)
    except AssertionError:
        raise AssertionError(chrome.find_element("tag name", "body").text) from None


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_from_a_dropped_file_to_an_export(
    page: tuple[Studio, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    studio, chrome = page
    studio.desk.plan_words = ["plan", "--no-probe"]  # a loaded machine measures for minutes
    mine = tmp_path_factory.mktemp("mine") / "fruit.ply"
    shutil.copyfile(studio.desk.folder / "melon.ply", mine)
    upload = until(lambda: chrome.find_elements("css selector", "input[type=file]"))[0]
    upload.send_keys(str(mine))
    says(chrome, "fruit.ply is there")
    until(lambda: chrome.find_elements("css selector", 'input[value="fruit.ply"]'))
    press(chrome, "Export")
    says(chrome, "fruit.ply has not been run")

    choose(chrome, GUESS, "fruit.watermelon")
    press(chrome, "Plan")
    says(chrome, "plan: done")
    press(chrome, "Run")
    says(chrome, "run: at work")
    press(chrome, "Plan")
    says(chrome, "run is at work")
    says(chrome, "run: done", 600.0)
    assert (studio.desk.out("fruit.ply") / "video.mp4").stat().st_size > 500

    choose(chrome, "mp4", "splat")
    press(chrome, "Export")
    says(chrome, "export splat: done")
    assert list(studio.desk.out("fruit.ply").rglob("*.splat"))

    press(chrome, "Watch")
    link = until(lambda: chrome.find_elements("css selector", "a#watch"))[0]
    chrome.get(link.get_attribute("href"))

    def greens() -> int:
        from PIL import Image

        shown = np.asarray(Image.open(io.BytesIO(chrome.get_screenshot_as_png())).convert("RGB"))
        r, g, b = shown.astype(int).transpose(2, 0, 1)
        return int(((g > r + 20) & (g > b + 20)).sum())

    until(lambda: greens() > 2000)
