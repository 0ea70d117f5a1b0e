"""`gsfluent run` end to end on a tiny splat: results, resuming, Ctrl-C, other views, exports."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ball_shot import write_shot
from scipy.spatial import cKDTree

from gsfluent.cli import main
from gsfluent.io import load_splats
from gsfluent.pipeline.light.from_shot import light_of
from gsfluent.pipeline.render.film import Film, drawn_by, poster_frame
from gsfluent.results.record import shot_of

FRAMES = 10
KEYS = {
    "version", "verdict", "reason", "device", "seed", "shot", "stages", "reconstruction", "fill",
    "texture", "simulation", "render", "outputs",
}  # fmt: skip
SIMULATION_KEYS = {
    "frames", "substeps", "dt_min", "dt_max", "dx", "particles", "active_blocks_max",
    "particle_steps_per_second", "rollbacks", "skipped", "per_frame",
}  # fmt: skip
PER_FRAME_KEYS = {
    "time", "kinetic", "elastic", "dissipated", "gravity", "momentum", "angular_momentum",
    "damaged_fraction", "fragments", "largest_fragment", "alpha_max", "non_finite",
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; tests that change it work on a copy."""
    root = tmp_path_factory.mktemp("finished")
    write_shot(root / "shot.yaml", ball)
    assert main(["run", str(root / "shot.yaml"), "-o", str(root / "out")]) == 0
    return root / "out"


def read(out: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((out / "run.json").read_text())
    return value


def resumed(record: dict[str, Any]) -> dict[str, bool]:
    return {stage["name"]: stage["resumed"] for stage in record["stages"]}


def test_a_run_leaves_what_it_promises(finished: Path) -> None:
    record = read(finished)
    assert set(record) >= KEYS
    assert record["verdict"] == "clean"
    page = (finished / record["outputs"]["report"]).read_text()
    assert record["outputs"]["video"] in page and "<svg" in page
    assert set(record["simulation"]) >= SIMULATION_KEYS
    per_frame = record["simulation"]["per_frame"]
    assert set(per_frame) >= PER_FRAME_KEYS
    assert all(len(values) == FRAMES for values in per_frame.values())
    assert record["fill"]["particles"] == record["simulation"]["particles"] > 1000
    assert record["fill"]["volume_m3"] == pytest.approx(4 / 3 * np.pi * 0.45**2, rel=0.3)
    render = record["render"]
    assert render["frames"] == FRAMES
    for name in ("hole_fraction", "see_through", "hole_fraction_around", "flicker"):
        assert len(render[name]) == len(render[f"{name}_before"]) == FRAMES
    assert len(render["transition_gaussians"]) == FRAMES
    for stage in record["stages"]:
        assert stage["seconds"] > 0
        assert stage["peak_memory_bytes"] > 50e6
    for name in record["outputs"].values():
        assert (finished / str(name).split(" to ")[0]).is_file()
    assert not list(finished.rglob("*partial*"))


def films(out: Path, count: int) -> list[Film]:
    shot = shot_of(out)
    return [Film(out, shot, light_of(shot), torch.device("cpu")) for _ in range(count)]


def test_pictures_drawn_on_several_devices_in_turn_are_those_of_one(finished: Path) -> None:
    want = [(frame.index, draw()) for frame, draw in drawn_by(films(finished, 1))]
    assert [index for index, _ in want] == list(range(FRAMES))
    for (index, one), (frame, draw) in zip(want, drawn_by(films(finished, 3)), strict=True):
        picture = draw()
        assert frame.index == index and one.report == picture.report
        for name in ("image", "alpha", "depth"):
            assert torch.equal(getattr(picture, name), getattr(one, name)), (index, name)


def test_a_picture_that_cannot_be_drawn_ends_the_film_on_every_device(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    three = films(finished, 3)
    monkeypatch.setattr(three[1], "picture", lambda *_: 1 / 0)
    drawn = []
    with pytest.raises(ZeroDivisionError):
        for frame, draw in drawn_by(three):
            draw()
            drawn.append(frame.index)
    assert drawn == [0]


def test_the_video_is_h264_yuv420p_and_has_all_frames(finished: Path) -> None:
    import imageio_ffmpeg

    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(finished / "video.mp4"))
    assert frames == FRAMES
    assert seconds == pytest.approx(FRAMES / 20, abs=0.06)
    meta = next(imageio_ffmpeg.read_frames(str(finished / "video.mp4")))
    assert meta["codec"].startswith("h264")
    assert meta["pix_fmt"].startswith("yuv420p")
    assert meta["source_size"] == (96, 64)


def test_the_pictures_show_something(finished: Path) -> None:
    from PIL import Image

    for name in ("poster.png", "interior.png"):
        pixels = np.asarray(Image.open(finished / name).convert("RGB"), dtype=float)
        assert pixels.std() > 5, f"{name} is blank"


def test_the_ply_sequence_is_standard_and_falls(finished: Path) -> None:
    files = sorted((finished / "frames").glob("frame_*.ply"))
    assert [f.name for f in files] == [f"frame_{i:04d}.ply" for i in range(1, FRAMES + 1)]
    first, later = load_splats(files[0]), load_splats(files[4])
    assert float(first.means[:, 2].mean() - later.means[:, 2].mean()) > 0.1
    header = files[0].read_bytes().split(b"end_header")[0]
    for name in (b"f_dc_0", b"opacity", b"scale_0", b"rot_0"):
        assert name in header


def test_running_again_redoes_nothing(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    shot = finished.parent / "shot.yaml"
    assert main(["run", str(shot), "-o", str(out)]) == 0
    record = read(out)
    assert all(resumed(record).values())
    assert record["simulation"] == read(finished)["simulation"]


def test_another_light_renders_again_and_nothing_else(
    finished: Path, ball: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    shot = write_shot(tmp_path / "shot.yaml", ball, light={"ambient": 0.2})
    assert main(["run", str(shot), "-o", str(out)]) == 0
    stages = resumed(read(out))
    assert stages.pop("render") is False
    assert all(stages.values())
    assert (out / "poster.png").read_bytes() != (finished / "poster.png").read_bytes()


def test_another_material_keeps_the_solid(finished: Path, ball: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    shot = write_shot(tmp_path / "shot.yaml", ball, objects={"ball": {"material": "jelly"}})
    assert main(["run", str(shot), "-o", str(out)]) == 0
    record = read(out)
    stages = resumed(record)
    assert stages["fill"] and stages["texture"]
    assert not stages["simulate"] and not stages["render"]
    assert max(record["simulation"]["per_frame"]["fragments"]) == 1  # jelly does not break


def test_ctrl_c_keeps_the_frames_and_run_goes_on(ball: Path, tmp_path: Path) -> None:
    output = {"fps": 60, "seconds": 0.5, "size": [96, 64]}
    shot = write_shot(tmp_path / "shot.yaml", ball, output=output, solve={"cells": 12})
    out = tmp_path / "out"
    frames = out / "stages" / "simulate"
    words = [sys.executable, "-m", "gsfluent", "run", str(shot), "-o", str(out)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, env=os.environ)
    deadline = time.monotonic() + 120
    while not (frames / "frame_0004.npz").exists():
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert "resume: run the same command again" in said
    assert "Traceback" not in said
    record = read(out)
    assert record["verdict"] == "failed"
    assert "interrupted" in record["reason"] and "simulate" in record["reason"]
    assert not list(out.rglob("*partial*"))
    assert not (out / "video.mp4").exists()
    first = (frames / "frame_0001.npz").stat().st_mtime_ns
    assert main(["run", str(shot), "-o", str(out)]) == 0
    record = read(out)
    assert record["verdict"] == "clean"
    assert resumed(record)["texture"] is True
    assert (frames / "frame_0001.npz").stat().st_mtime_ns == first
    assert len(record["simulation"]["per_frame"]["time"]) == 30


def test_full_disk_during_the_simulation_keeps_what_is_done(
    finished: Path,
    ball: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import errno

    out = tmp_path / "out"
    shutil.copytree(finished, out)
    shot = write_shot(tmp_path / "shot.yaml", ball, events=[{"type": "drop", "height": 0.2}])
    save = np.savez
    written = []

    def filling(stream: Any, **arrays: Any) -> None:
        written.append(stream.name)
        if len(written) > 3:
            stream.write(b"x" * 1000)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(stream, **arrays)

    monkeypatch.setattr("gsfluent.results.frames.np.savez", filling)
    assert main(["run", str(shot), "-o", str(out)]) == 1
    said = capsys.readouterr().err
    assert os.strerror(errno.ENOSPC) in said
    assert not list(out.rglob("*partial*"))
    assert read(out)["verdict"] == "failed"
    monkeypatch.setattr("gsfluent.results.frames.np.savez", save)
    assert main(["run", str(shot), "-o", str(out)]) == 0
    assert read(out)["verdict"] == "clean"


def test_render_again_with_another_camera_and_size(finished: Path, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "path.json"
    frames = [{"eye": [0.0, -6.0, 2.0], "target": [0.0, 0.0, 0.5]}]
    path.write_text(json.dumps({"frames": frames}))
    still = tmp_path / "still.png"
    words = ["render", str(finished), "--camera", str(path), "--size", "64x48", "--frame", "2"]
    assert main([*words, "-o", str(still), "--light=-1,-1,3", "--ambient", "0.3"]) == 0
    assert Image.open(still).size == (64, 48)
    clip = tmp_path / "clip.mp4"
    assert main(["render", str(finished), "--size", "64x48", "-o", str(clip)]) == 0
    assert clip.stat().st_size > 500


@pytest.mark.parametrize("extra", [["--frame", "99"], ["-o", "clip.gif"], ["--camera", "0"]])
def test_render_refuses_what_it_cannot(
    finished: Path, extra: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", str(finished), *extra]) == 2
    assert "hint:" in capsys.readouterr().err


def test_export_vtk_holds_the_particles(finished: Path) -> None:
    assert main(["export", str(finished), "--to", "vtk"]) == 0
    text = (finished / "particles" / "particles_0003.vtk").read_bytes()
    count = read(finished)["simulation"]["particles"]
    assert f"POINTS {count} float".encode() in text
    start = text.index(b"float\n") + 6
    points = np.frombuffer(text[start : start + 12 * count], dtype=">f4").reshape(-1, 3)
    assert np.isfinite(points).all()
    assert 0.0 < points[:, 2].mean() < 1.5


def test_export_hands_a_real_run_on(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", str(finished), "--to", "delta,spz,png,ply-seq", "--frames", "::4"]
    words += ["--size", "64x48", "--camera", "turntable", "-o", str(tmp_path), "--json"]
    assert main(words) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["spz"] == "spz/frame_0001.spz to frame_0009.spz"
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 3
    assert main(["export", str(tmp_path / "splats.gsd"), "--to", "ply-seq"]) == 0
    for number in (1, 2, 3):
        unpacked = load_splats(tmp_path / "splats" / "frames" / f"frame_{number:04d}.ply")
        straight = load_splats(tmp_path / "frames" / f"frame_{4 * number - 3:04d}.ply")
        assert unpacked.count == straight.count
        off, _ = cKDTree(straight.means.double()).query(unpacked.means[::50].double())
        finest = straight.scales.median(dim=1).values.quantile(0.1)
        assert float(off.max()) < 3**0.5 * 0.031 * float(finest)


def test_plan_agrees_with_the_run(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", str(finished.parent / "shot.yaml"), "--json", "--no-probe"]) == 0
    plan = json.loads(capsys.readouterr().out)
    simulation = read(finished)["simulation"]
    assert plan["frames"] == FRAMES
    assert plan["dx"] == pytest.approx(simulation["dx"], rel=0.1)
    assert plan["particles"] == pytest.approx(simulation["particles"], rel=0.3)
    assert plan["substeps"] == pytest.approx(simulation["substeps"], rel=0.7)
    needed = {row["pass"]: row["needed"] for row in plan["passes"]}
    assert needed["contact fields"] or simulation["fields_max"] == 1
    assert needed["blades"] is False
    assert plan["memory_bytes"] > 1e6


@pytest.mark.parametrize(
    ("fragments", "expected"),
    [([1, 1, 1, 9, 9, 9, 9, 9], 4), ([1] * 8, 4), ([1, 1, 5], 2)],
)
def test_the_poster_follows_the_largest_break(fragments: list[int], expected: int) -> None:
    assert poster_frame(fragments, fps=10) == expected


def test_a_bullet_can_be_seen(finished: Path, ball: Path, tmp_path: Path) -> None:
    from gsfluent.data import TRANSITION
    from gsfluent.results.frames import load_frame

    out = tmp_path / "out"
    shutil.copytree(finished, out)
    bullet = {"type": "bullet", "from": [0, -3, 0.5], "toward": [0, 0, 0.5], "speed": 20}
    shot = write_shot(
        tmp_path / "shot.yaml",
        ball,
        events=[{**bullet, "radius": 0.2}],
        output={"fps": 20, "seconds": 0.1, "size": [96, 64]},
    )
    assert main(["run", str(shot), "-o", str(out)]) == 0
    frame = load_frame(out / "stages" / "simulate", 0)
    before = load_frame(finished / "stages" / "simulate", 0)
    added = frame.carried - before.carried
    assert added > 100
    steel = frame.gaussians.means[before.carried : frame.carried]
    torch.testing.assert_close(steel.mean(dim=0), torch.tensor([0.0, -3.0, 0.5]), atol=0.05, rtol=0)
    labels = frame.gaussians.labels
    assert labels is not None and bool((labels[frame.carried :] == TRANSITION).all())
