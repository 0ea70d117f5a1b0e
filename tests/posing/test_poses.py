"""Poses of drawn photographs whose cameras are known, and frames of a drawn video."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from papered_corner import FOCAL, HEIGHT, VIEWS, WIDTH, eyes, photograph, walls
from PIL import Image

from gsfluent.cli import main
from gsfluent.errors import InputError, RunError
from gsfluent.io import load_capture
from gsfluent.posing.colmap import find_poses
from gsfluent.posing.frames import take_frames


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    papers = walls()
    for number, eye in enumerate(eyes()):
        Image.fromarray(photograph(eye, papers)).save(folder / f"{number:02d}.png")
    return folder


def test_cameras_are_found_where_they_were(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap")
    out = tmp_path / "capture"
    assert main(["poses", str(photographs), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"{VIEWS} of {VIEWS} photographs have poses" in said and "next: gsfluent run" in said
    report = json.loads((out / "poses.json").read_text())
    assert report["registered"] == VIEWS and report["missing"] == [] == report["advice"]
    assert report["reprojection_error"] < 1.0 and report["points"] > 100
    assert {path.name for path in out.iterdir()} == {"images", "sparse", "poses.json"}
    capture = load_capture(out)
    found = np.stack([
        (-camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]).numpy() for camera in capture.cameras
    ])  # fmt: skip
    # the frame and the scale are free: the best similarity (Umeyama 1991)
    a, b = found - found.mean(axis=0), eyes() - eyes().mean(axis=0)
    left, sizes, right = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.linalg.det(left @ right)])
    scale = (sizes * flip.diagonal()).sum() / (a**2).sum()
    off = np.linalg.norm(scale * a @ (left @ flip @ right).T - b, axis=1)
    assert off.max() < 0.03  # of an arc 3 across
    focal = float(capture.cameras[0].K[0, 0])
    assert focal == pytest.approx(FOCAL, rel=0.05)
    # a second time it is refused, nothing is overwritten
    assert main(["poses", str(photographs), "-o", str(out)]) == 2


def test_what_does_not_fit_is_said(photographs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    folder = tmp_path / "mixed"
    folder.mkdir()
    for path in photographs.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    for number in range(4):  # of something else
        noise = np.random.default_rng(number).integers(
            0, 255, (HEIGHT // 4, WIDTH // 4, 3), np.uint8
        )
        other = Image.fromarray(noise).resize((WIDTH, HEIGHT))
        other.save(folder / f"other{number}.png")
    report = find_poses(folder, tmp_path / "out")
    assert report["registered"] == VIEWS
    assert report["missing"] == [f"other{k}.png" for k in range(4)]
    assert "4 of 13 photographs found no place" in report["advice"][0]
    plain = tmp_path / "plain"
    plain.mkdir()
    for number in range(3):
        Image.new("RGB", (WIDTH, HEIGHT), (120, 120, 120)).save(plain / f"{number}.png")
    with pytest.raises(RunError, match="no three of 3 photographs fit") as caught:
        find_poses(plain, tmp_path / "none")
    assert "newspaper" in caught.value.hint
    assert list((tmp_path / "none").iterdir()) == []


@pytest.mark.parametrize(
    ("end", "why"), [("os.abort()", "ended with -"), ("raise ValueError('bad photograph')", "bad")]
)
def test_what_colmap_dies_of_ends_there(
    end: str, why: str, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pycolmap")
    (tmp_path / "pycolmap.py").write_text(f"import os\n{end}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(RunError, match=why) as caught:
        find_poses(photographs, tmp_path / "out")
    assert "newspaper" in caught.value.hint
    assert list((tmp_path / "out").iterdir()) == []


def test_wrong_inputs(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError, match="0 photographs"):
        find_poses(tmp_path, tmp_path / "out")
    (tmp_path / "a.txt").write_text("no video")
    with pytest.raises(InputError, match="neither a folder nor a video"):
        find_poses(tmp_path / "a.txt", tmp_path / "out")


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    import imageio_ffmpeg

    size = (frames[0].shape[1], frames[0].shape[0])
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=10, macro_block_size=2, quality=9)
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()


def test_of_a_video_the_sharp_frames_are_taken(tmp_path: Path) -> None:
    papers = walls()
    frames, sharp = [], []
    for number, eye in enumerate(eyes(5)):
        clear = photograph(eye, papers)
        blurred = cv2.GaussianBlur(clear, (0, 0), 4)
        stretch = [blurred] * 4
        stretch[number % 4] = clear
        frames += stretch
        sharp.append(clear)
    write_video(tmp_path / "a.mp4", frames)
    (tmp_path / "frames").mkdir()
    taken = take_frames(tmp_path / "a.mp4", tmp_path / "frames", 5)
    assert [path.name for path in taken] == [f"{k:04d}.jpg" for k in range(5)]
    for path, clear in zip(taken, sharp, strict=True):
        off = np.abs(np.asarray(Image.open(path)).astype(int) - clear).mean()
        assert off < 6  # the blurred one is off by 20 and more
    for more in (3, 50):
        assert len(take_frames(tmp_path / "a.mp4", tmp_path / "frames", more)) == min(more, 20)


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    # a playlist under the name of a video would open other files
    (tmp_path / "a.mp4").write_text(f"ffconcat version 1.0\nfile '{secret}'\n")
    (tmp_path / "b.mp4").write_bytes(b"")
    (tmp_path / "c.mov").write_text(f"#EXTM3U\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n")
    for name in ("a.mp4", "b.mp4", "c.mov"):
        with pytest.raises(InputError, match="ffmpeg cannot read it"):
            take_frames(tmp_path / name, tmp_path, 5)
    with pytest.raises(InputError, match="at least 3"):
        take_frames(tmp_path / "a.mp4", tmp_path, 2)
    with pytest.raises(InputError, match="no such video"):
        take_frames(tmp_path / "d.mp4", tmp_path, 5)
