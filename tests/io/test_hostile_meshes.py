"""Meshes and labels that lie, ask for too much, or lead elsewhere: the usual error, at once."""

from __future__ import annotations

import io
import json
import os
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from gsfluent.config import Select
from gsfluent.data import Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.io.checked.inside import allow_outside
from gsfluent.run.report import read_run
from gsfluent.spatial.mesh_file import load_mesh, mesh_files
from gsfluent.spatial.mesh_surface import surface_points
from gsfluent.stages.select import select_mask


def refused(read: Callable[[], Any], said: str) -> InputError:
    """The error, after a check that little was allocated on the way to it."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=said) as caught:
            read()
        assert tracemalloc.get_traced_memory()[1] < 1 << 26
    finally:
        tracemalloc.stop()
    assert caught.value.hint
    return caught.value


def gltf(folder: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """A box as ``a.gltf`` with its buffers beside it, edited."""
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.creation.box().scene()).items():
        (folder / name.replace("model", "a")).write_bytes(data)
    document = json.loads((folder / "a.gltf").read_text())
    edit(document)
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def obj(folder: Path, head: str = "") -> Path:
    (folder / "a.obj").write_text(f"{head}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return folder / "a.obj"


@pytest.mark.parametrize("kind", ["obj", "stl", "off", "ply", "glb", "gltf"])
def test_pipes_and_folders_are_no_meshes(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    refused(lambda: load_mesh(path), "no such")
    os.mkfifo(path)
    refused(lambda: load_mesh(path), "is a pipe or device")
    assert mesh_files(path) == []  # asked before it is read
    path.unlink()
    path.mkdir()
    refused(lambda: surface_points(path, 9), "is a folder")


def test_a_pipe_beside_a_mesh_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mtl")
    refused(lambda: load_mesh(obj(tmp_path, "mtllib a.mtl")), r"a\.mtl: is a pipe")


@pytest.mark.parametrize("kind", ["zip", "tar.gz", "xyz", "dxf", "msgpack"])
def test_archives_and_formats_without_need_are_not_tried(kind: str, tmp_path: Path) -> None:
    (tmp_path / f"a.{kind}").write_bytes(b"x")
    refused(lambda: load_mesh(tmp_path / f"a.{kind}"), "not a mesh by its ending")


@pytest.mark.parametrize(
    "edit",
    [
        lambda d: d["accessors"][0].update(count=10**12),
        lambda d: [d["accessors"][0].pop("bufferView"), d["accessors"][0].update(count=10**9)],
        lambda d: [
            d["accessors"][0].update(count=10**9),
            d["bufferViews"][d["accessors"][0]["bufferView"]].update(byteStride=0),
        ],
        lambda d: d["accessors"][0].update(count=-(10**12)),
    ],
    ids=["more", "of nothing", "the same", "less"],
)
def test_accessors_that_promise(edit: Callable[[Any], object], tmp_path: Path) -> None:
    refused(lambda: load_mesh(gltf(tmp_path, edit)), "above the limit")


def test_a_binary_accessor_that_promises(tmp_path: Path) -> None:
    data = trimesh.creation.box().export(file_type="glb")
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    document["accessors"][0].update(count=10**12)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, len(data) + len(text) - size, len(text), 0x4E4F534A)
    (tmp_path / "a.glb").write_bytes(head + text + data[20 + size :])
    refused(lambda: load_mesh(tmp_path / "a.glb"), "above the limit")


def test_files_of_a_mesh_together_keep_to_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = obj(tmp_path, "mtllib a.mtl")
    with open(tmp_path / "a.mtl", "wb") as stream:
        stream.truncate(4000)  # of nothing
    assert len(load_mesh(path).faces) == 1
    monkeypatch.setenv("GSFLUENT_MAX_UNPACKED_BYTES", "1000")
    monkeypatch.setattr("gsfluent.io.checked.limits.EXPANSION", 0)
    refused(lambda: load_mesh(path), "above the limit of")


@pytest.mark.parametrize("name", ["/etc/hostname", "../secret.bin", "a/../../secret.bin"])
def test_names_that_leave_the_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(4000))
    room = tmp_path / "room"
    room.mkdir()
    path = gltf(room, lambda d: d["buffers"][0].update(uri=name))
    error = refused(lambda: load_mesh(path), "lies outside")
    assert "--allow-outside" in error.hint
    refused(lambda: surface_points(obj(room, f"mtllib {name}"), 9), "lies outside")


def test_outside_is_read_when_allowed(tmp_path: Path) -> None:
    room = tmp_path / "room"
    room.mkdir()
    path = gltf(room, lambda d: None)
    name = json.loads(path.read_text())["buffers"][0]["uri"]
    (room / name).rename(tmp_path / name)
    path = room / "a.gltf"
    path.write_text(path.read_text().replace(name, f"../{name}"))
    with allow_outside():
        assert load_mesh(path).volume == pytest.approx(1.0)


def test_textures_of_absurd_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import Image

    box = trimesh.creation.box()
    paint = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (200, 100)))
    box.visual = trimesh.visual.TextureVisuals(np.zeros((len(box.vertices), 2)), material=paint)
    box.export(tmp_path / "a.glb")
    assert surface_points(tmp_path / "a.glb", 9).colored
    monkeypatch.setenv("GSFLUENT_MAX_PIXELS", "19999")
    refused(lambda: surface_points(tmp_path / "a.glb", 9), "20000 pixels")


@pytest.mark.parametrize("word", ["nan", "inf", "1e999"])
def test_corners_that_are_not_finite(word: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {word}\nf 1 2 3\nf 1 2 4\n")
    for read in (load_mesh, lambda p: surface_points(p, 9)):
        refused(lambda read=read: read(path), "a.obj: cannot be read as a mesh")


# --- labels of splats, and the record of a run ---


def chosen(path: Path, count: int = 4) -> Any:
    points = torch.zeros(count, 3)
    splats = Gaussians.from_colors(points, torch.full((count,), 0.1), points)
    return select_mask(splats, Select(labels=path), Frame.identity())


def test_labels_of_splats(tmp_path: Path) -> None:
    path = tmp_path / "labels.npy"
    np.save(path, np.array([0, 1, 1, 0]))
    assert chosen(path).tolist() == [False, True, True, False]
    with pytest.raises(InputError, match=r"no splat has label 1 in .*labels\.npy"):
        np.save(path, np.zeros(4, int))
        chosen(path)
    with pytest.raises(InputError, match=r"whole numbers \[4\], got float64 \[4\]"):
        np.save(path, np.zeros(4))
        chosen(path)
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<i8", "fortran_order": False, "shape": (10**12,)}
    )
    path.write_bytes(stream.getvalue())
    refused(lambda: chosen(path), "select.labels: .* declares")
    path.unlink()
    os.mkfifo(path)
    refused(lambda: chosen(path), "is a pipe")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"verdict": ' + "1" * 5000 + "}", "{", "[]"])
def test_records_of_runs(text: str, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(text)
    refused(lambda: read_run(tmp_path), "run.json")
