"""Zips of captures, and what Polycam and RealityCapture export; the files are written here."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import pytest
import torch
from capture_files import (
    assert_same_poses,
    opengl_matrix,
    ring,
    write_colmap,
    write_images,
    write_transforms,
)

from gsfluent.errors import InputError
from gsfluent.io import kind_of, load_capture
from gsfluent.run.from_input import find_input

PINHOLE = [48.0, 48.0, 20.0, 15.0]


def pack(folder: Path, path: Path, under: str = "") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, f"{under}{file.relative_to(folder)}")
    return path


def colmap_capture(folder: Path, text: bool = False) -> Path:
    write_images(folder / "images", ring())
    write_colmap(folder / "sparse" / "0", ring(), "PINHOLE", PINHOLE, text)
    return folder


@pytest.mark.parametrize("under", ["", "export/", "export/scan 1/"])
def test_a_zip_with_sparse_is_a_capture(tmp_path: Path, under: str) -> None:
    colmap_capture(tmp_path / "raw")
    (tmp_path / "raw" / "thumbs.db").write_bytes(b"not of a capture")
    packed = pack(tmp_path / "raw", tmp_path / "scan.zip", under)
    assert kind_of(packed) == "capture" and find_input(packed) == ("capture", packed)
    capture = load_capture(packed)
    assert_same_poses(capture, ring())
    assert capture.view(0).image.shape == (30, 40, 3)
    folder = tmp_path / "scan_unpacked"
    assert not list(folder.rglob("thumbs.db"))
    # the second time nothing is written; another zip of that name is not taken for it
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*")}
    assert len(load_capture(packed)) == 4
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*")} == before
    os.utime(packed, (0, 0))
    with pytest.raises(InputError, match=r"is not from scan\.zip"):
        load_capture(packed)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["raw", "scan.zip", "scan_unpacked"]


def test_a_zip_with_transforms(tmp_path: Path) -> None:
    write_images(tmp_path / "raw" / "images", ring())
    shared = {"fl_x": 48.0, "w": 40, "h": 30}
    write_transforms(tmp_path / "raw" / "transforms.json", ring(), shared)
    assert_same_poses(load_capture(pack(tmp_path / "raw", tmp_path / "a.zip")), ring())


@pytest.mark.parametrize("name", ["../evil.txt", "/evil.txt", "a/../../evil.txt", "..\\evil.txt"])
def test_a_zip_cannot_leave_its_folder(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("images/0.png", b"")
        archive.writestr(name, b"evil")
    with pytest.raises(InputError, match="leads out of the folder"):
        load_capture(tmp_path / "a.zip")
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]


def test_zips_that_are_none_or_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.zip").write_bytes(b"PK no zip")
    with pytest.raises(InputError, match="the zip is damaged"):
        load_capture(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "b.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("images/0.png", bytes(1 << 24))
    monkeypatch.setenv("GSFLUENT_MAX_UNPACKED_BYTES", "1e6")
    with pytest.raises(InputError, match="above the limit"):
        load_capture(tmp_path / "b.zip")
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("readme.md", "nothing")
    with pytest.raises(InputError, match="no COLMAP model and no transforms"):
        load_capture(tmp_path / "c.zip")


def write_polycam(folder: Path, cameras: str, images: str) -> None:
    """A raw export: camera-to-world with OpenGL axes in a world whose +y is up."""
    write_images(folder / "keyframes" / images, ring(), [f"{k}00.jpg" for k in range(4)])
    place = folder / "keyframes" / cameras
    place.mkdir(parents=True)
    theirs = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)  # from our xyz
    for number, camera in enumerate(ring()):
        pose = theirs @ torch.tensor(opengl_matrix(camera), dtype=torch.float64)[:3]
        values = {f"t_{r}{c}": float(pose[r, c]) for r in range(3) for c in range(4)}
        lens = {"fx": 48.0, "fy": 48.0, "cx": 20.0, "cy": 15.0, "width": 40, "height": 30}
        (place / f"{number}00.json").write_text(json.dumps(values | lens | {"blur_score": 90.0}))


def test_a_raw_export_of_polycam(tmp_path: Path) -> None:
    write_polycam(tmp_path, "cameras", "images")
    assert kind_of(tmp_path) == "capture"
    capture = load_capture(tmp_path)
    for found, wanted in zip(capture.cameras, ring(), strict=True):
        torch.testing.assert_close(found.viewmat, wanted.viewmat, atol=1e-6, rtol=0)
    assert float(capture.cameras[0].K[0, 0]) == 48.0 and capture.view(1).image.shape[:2] == (30, 40)
    write_polycam(tmp_path, "corrected_cameras", "corrected_images")
    path = load_capture(tmp_path).cameras[0].image_path
    assert path is not None and path.parent.name == "corrected_images"
    camera = tmp_path / "keyframes" / "corrected_cameras" / "000.json"
    camera.write_text("{}")
    with pytest.raises(InputError, match="no camera of Polycam"):
        load_capture(tmp_path)


def test_what_reality_capture_exports_for_colmap(tmp_path: Path) -> None:
    """The text model in a folder of its own, photographs undistorted beside it."""
    write_images(tmp_path / "images", ring())
    write_colmap(tmp_path / "sparse", ring(), "PINHOLE", PINHOLE, text=True)
    assert_same_poses(load_capture(tmp_path), ring())
