"""What the viewer makes of a folder: finished, at work, damaged, only filled, not a run at all."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from viewer_scene import FPS, FRAMES, GREEN, RADIUS, frame, write_run

import gsfluent as gf
from gsfluent.cli import main
from gsfluent.data import SURFACE
from gsfluent.errors import InputError, RunError
from gsfluent.io.solid import save_solid
from gsfluent.results.frames import frame_path, save_frame
from gsfluent.viewer.model.color import splat_colors
from gsfluent.viewer.model.look import BODY
from gsfluent.viewer.model.source import RunSource
from gsfluent.viewer.model.timeline import Timeline
from gsfluent.viewer.server import free_port

CPU = torch.device("cpu")


def age(out: Path, seconds: float) -> None:
    """Set back the clock of everything in a run."""
    then = time.time() - seconds
    for path in [*out.rglob("*")]:
        os.utime(path, (then, then))


def test_a_finished_run_is_named_with_its_verdict_and_holes(tmp_path: Path) -> None:
    source = RunSource(write_run(tmp_path / "ball"))
    assert source.count() == FRAMES and not source.running
    assert source.state() == f"**Clean:** {FRAMES} frames."
    assert source.facts(3)["holes"] == 0.03
    assert source.facts(3)["time"] == pytest.approx(3 / FPS)


def test_a_finished_run_is_named_with_its_notes(tmp_path: Path) -> None:
    out = write_run(tmp_path / "ball")
    record = {"verdict": "clean", "simulation": {"notes": ["nothing broke"]}}
    (out / "run.json").write_text(json.dumps(record))
    assert RunSource(out).state() == f"**Clean:** {FRAMES} frames. nothing broke."


def test_a_run_at_work_grows_and_a_killed_one_is_called_stopped(tmp_path: Path) -> None:
    out = write_run(tmp_path / "ball", 2, finished=False)
    source = RunSource(out)
    timeline = Timeline(source, CPU)
    assert source.running and source.state() == "**Running:** 2 frames so far."
    assert not timeline.refresh()
    save_frame(out / "stages" / "simulate", frame(2))
    assert timeline.refresh() and timeline.count == 3
    assert [row["time"] for row in timeline.facts()] == pytest.approx([0.0, 1 / FPS, 2 / FPS])
    age(out, 600.0)
    assert not source.running
    assert source.state() == "**Stopped:** 3 frames; no new one for 10 min."


def test_missing_and_damaged_frames_are_named_and_the_others_shown(tmp_path: Path) -> None:
    out = write_run(tmp_path / "ball")
    folder = out / "stages" / "simulate"
    frame_path(folder, 1).unlink()
    frame_path(folder, 3).write_bytes(b"PK\x03\x04 cut short")
    timeline = Timeline(RunSource(out), CPU)
    assert timeline.count == FRAMES
    assert timeline.source.state() == "**Clean:** 4 frames. Missing: 2."
    assert [bool(row) for row in timeline.facts()] == [True, False, True, False, True]
    for index in (1, 3):
        with pytest.raises(RunError, match=f"frame_000{index + 1}.npz: no readable frame"):
            timeline.frame(index)
    assert timeline.frame(2).index == 2
    assert timeline.fps() == pytest.approx(FPS / 2)  # three known frames over four steps of time


def test_not_one_readable_frame_is_an_error(tmp_path: Path) -> None:
    out = write_run(tmp_path / "ball", 2)
    for index in range(2):
        frame_path(out / "stages" / "simulate", index).write_bytes(b"")
    with pytest.raises(RunError, match="no frame can be shown"):
        Timeline(RunSource(out), CPU)


def test_a_filled_solid_is_shown_until_frames_come(tmp_path: Path) -> None:
    whole = frame(0).gaussians
    skin = whole.select(whole.labels == SURFACE)
    solid = gf.pipeline.Fill(resolution=20)(skin)
    out = tmp_path / "ball"
    (out / "stages" / "fill").mkdir(parents=True)
    save_solid(solid, out / "stages" / "fill" / "ball.ply")
    (out / "stages" / "fill" / "stage.json").write_text('{"complete": true}')
    source = RunSource(out)
    timeline = Timeline(source, CPU)
    assert source.count() == 1
    assert source.state() == "**Running:** the filled solid; nothing is simulated yet."
    seen = timeline.frame(0)
    volume = 4.0 / 3.0 * np.pi * RADIUS**3
    assert float(seen.volumes.sum()) == pytest.approx(volume, rel=0.15)
    _, legend = splat_colors(seen, timeline, BODY)
    assert legend is not None and legend.entries[0][1].startswith("ball")
    # every splat follows a point beside it
    apart = (seen.positions[seen.anchor.long()] - seen.gaussians.means).norm(dim=1)
    assert float(apart.max()) < 2.5 * solid.voxel
    write_run(out, 2, finished=False)
    assert timeline.refresh() and timeline.count == 2
    assert timeline.frame(0).positions.shape[0] == frame(0).positions.shape[0]


@pytest.mark.parametrize("folder", ["empty", "stages"])
def test_what_is_not_a_run_is_refused(tmp_path: Path, folder: str) -> None:
    (tmp_path / "out" / folder).mkdir(parents=True)
    with pytest.raises(InputError, match="OUT: ") as error:
        RunSource(tmp_path / "out")
    assert error.value.hint


def test_a_redone_simulation_replaces_the_old_frames(tmp_path: Path) -> None:
    out = write_run(tmp_path / "ball")
    timeline = Timeline(RunSource(out), CPU)
    shutil.rmtree(out / "stages" / "simulate")
    write_run(out, 1, finished=False)
    marker = out / "stages" / "simulate" / "stage.json"
    marker.write_text(json.dumps({"fingerprint": "another", "complete": False}))
    assert timeline.refresh() and timeline.count == 1


def test_a_port_in_use_gives_the_next_one() -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) <= port + 50
    with pytest.raises(InputError, match="--port 70000"):
        free_port("127.0.0.1", 70000)
    with pytest.raises(InputError, match=r"--host 203\.0\.113\.7"):
        free_port("203.0.113.7", 0)


def test_check_draws_the_object_and_leaves_stdout_to_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser")
    out = write_run(tmp_path / "ball")
    assert main(["view", str(out), "--check", "--json", "--device", "cpu"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["frames"] == FRAMES and answer["output"] == str(out / "view.png")
    picture = gf.io.load_image(out / "view.png")
    r, g, b = picture[..., 0], picture[..., 1], picture[..., 2]
    green = (g > r + 0.1) & (g > b + 0.1)
    assert 0.05 < float(green.float().mean()) < 0.6
    # the skin has the colour it was given, up to shading
    hue = picture[green].mean(0)
    assert float(hue[1] / hue[0]) == pytest.approx(GREEN[1] / GREEN[0], rel=0.35)


def test_without_viser_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    out = write_run(tmp_path / "ball", 1)
    assert main(["view", str(out), "--check"]) == 2
    assert 'pip install "gsfluent[viewer]"' in capsys.readouterr().err


def test_it_serves_until_interrupted(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    import re
    import signal
    import subprocess
    import sys
    import urllib.request

    out = write_run(tmp_path / "ball", 2)
    command = [sys.executable, "-m", "gsfluent", "view", str(out), "--no-open", "--port", "0"]
    process = subprocess.Popen(
        [*command, "--device", "cpu"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        found = re.search(r"viewer: (http://127\.0\.0\.1:\d+) ", line)
        assert found, line
        with urllib.request.urlopen(found.group(1), timeout=10) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0, rest
    assert "Traceback" not in rest
