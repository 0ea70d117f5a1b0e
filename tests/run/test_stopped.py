"""What a run leaves that stops, and what is heard while it goes on."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import pytest
import torch

from gsfluent.config import Shot
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io import save_splats
from gsfluent.progress import LineReporter, heard_warnings, heartbeat, quiet_logs
from gsfluent.run.shot import run_shot


def test_a_stopped_run_leaves_no_film_of_an_earlier_one(tmp_path: Path) -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    save_splats(Gaussians.from_colors(points, torch.full((50,), 0.1), points), tmp_path / "few.ply")
    out = tmp_path / "out"
    out.mkdir()
    for name in ("video.mp4", "poster.png", "mine.txt"):
        (out / name).write_bytes(b"old")
    # a photograph's index without photographs is refused before any work
    values = {"splats": str(tmp_path / "few.ply"), "output": {"camera": 3}}
    with pytest.raises(InputError):
        run_shot(Shot.from_dict(values), out)
    assert not (out / "video.mp4").exists() and not (out / "poster.png").exists()
    assert (out / "mine.txt").is_file() and (out / "run.json").is_file()


def test_a_silence_is_broken() -> None:
    spoken = threading.Event()

    def says() -> str:
        spoken.set()
        return "at work"

    with heartbeat("gsfluent", says, seconds=0.02) as watched:
        task = watched(LineReporter()).task("fill")
        assert spoken.wait(60.0)
        task(1, 2, "")  # a reporter works on
    spoken.clear()
    assert not spoken.wait(0.2)  # over is over


def test_a_silence_is_broken_while_small_runs_are_kept_quiet() -> None:
    said = threading.Event()

    class Hears(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            assert record.getMessage() == "100 % at work"
            said.set()

    log, hears = logging.getLogger("gsfluent"), Hears()
    log.addHandler(hears)
    try:
        with quiet_logs("gsfluent"), heartbeat("gsfluent", lambda: "100 % at work", seconds=0.02):
            assert said.wait(60.0)
    finally:
        log.removeHandler(hears)


def test_progress_says_what_is_left(caplog: pytest.LogCaptureFixture) -> None:
    def adds(name: str, done: int, total: int) -> str:
        return f"{total - done} to go with {name}"

    with (
        caplog.at_level(logging.INFO),
        heartbeat("gsfluent", lambda: "", adds=adds) as watched,
    ):
        task = watched(LineReporter(seconds=0.0)).task("fill")
        task(1, 3, "voxels")
        task(2, 3, "")
    assert "fill: 1/3 voxels, 2 to go with fill" in caplog.messages
    assert "fill: 2/3 1 to go with fill" in caplog.messages


def test_warnings_are_heard_once() -> None:
    log = logging.getLogger("gsfluent.somewhere")
    with heard_warnings("gsfluent") as heard:
        for _ in range(2):
            log.warning("%s is thin", "it")
        log.info("nothing")
    log.warning("later")
    assert heard == ["it is thin"]
