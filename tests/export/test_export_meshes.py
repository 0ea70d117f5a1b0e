"""Fragments as closed surfaces, checked by trimesh, pxr and known shapes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from export_run import FRAMES, make_run, points_of_a_cube

from gsfluent.errors import InputError
from gsfluent.export.frames import FrameSequence
from gsfluent.export.meshes import Piece, fragment_meshes, surface
from gsfluent.export.write import ExportOptions, export
from gsfluent.pipeline.matter.debris import clinging

pytest.importorskip("skimage")
CPU = torch.device("cpu")
HALF = 0.2**3 / 2


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("meshes"), degree=0)


def write(run: Path, to: Path, kind: str = "meshes", **options: Any) -> Path:
    export(run, [kind], device=CPU, to=to, options=ExportOptions(**options))
    return to


def by_fragment(path: Path) -> dict[int, trimesh.Trimesh]:
    """The pieces of a .ply by its property ``fragment``."""
    mesh = trimesh.load(path, process=False)
    number = np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"]["fragment"]).reshape(-1)
    return {
        int(n): mesh.submesh([np.flatnonzero(number[mesh.faces[:, 0]] == n)], repair=False)[0]
        for n in np.unique(number)
    }


def test_every_fragment_is_closed_and_of_its_volume(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path)
    for index in range(FRAMES):
        pieces = by_fragment(tmp_path / "meshes" / f"frame_{index + 1:04d}.ply")
        assert len(pieces) == (1 if index < 2 else 2)
        for mesh in pieces.values():
            assert mesh.is_watertight and mesh.is_winding_consistent
        volumes = [mesh.volume for mesh in pieces.values()]
        wanted = [2 * HALF] if index < 2 else [HALF, HALF]
        assert volumes == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("blur", [0.75, 1.0, 2.0])
def test_a_ball_is_a_ball(blur: float) -> None:
    axis = np.arange(-14, 15) * 0.01
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    # points that lie as a simulation leaves them: not on a lattice
    grid += np.random.default_rng(0).uniform(-0.3, 0.3, grid.shape) * 0.01
    inside = grid[np.linalg.norm(grid, axis=1) < 0.12]
    volumes = np.full(len(inside), 4 / 3 * np.pi * 0.12**3 / len(inside))
    vertices, faces = surface(inside, volumes, 0.01, blur)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    assert mesh.volume == pytest.approx(volumes.sum(), rel=0.005)
    off = np.linalg.norm(vertices, axis=1) - 0.12
    assert np.abs(off).max() < 0.009  # spacings
    assert off.std() < (0.0025 if blur < 1 else 0.002)
    outward = np.einsum("ij,ij->i", mesh.vertex_normals, vertices / 0.12)
    assert outward.mean() > 0.95


def test_pieces_of_a_few_points_and_far_apart() -> None:
    cube, volume = points_of_a_cube()
    few = cube[:1].double().numpy()
    for where in (few, np.concatenate([few, few + 3.0, few - 2.0])):
        volumes = np.full(len(where), volume)
        mesh = trimesh.Trimesh(*surface(where, volumes, volume ** (1 / 3)), process=False)
        assert mesh.is_watertight and mesh.body_count == len(where)
        assert mesh.volume == pytest.approx(volumes.sum(), rel=0.05)


def test_debris_goes_with_the_piece_it_lies_on() -> None:
    line = np.arange(10.0)[:, None] * [1.0, 0.0, 0.0]
    fragment = np.array([3, 3, -1, -1, -1, -1, 8, 8, -1, -1])
    line[8:] += 5.0  # a spray
    assert clinging(line, fragment, 1.5).tolist() == [3, 3, 3, 3, 8, 8, 8, 8, -1, -1]
    alone = np.full(4, -1)
    assert clinging(line[:4], alone, 1.5).tolist() == [-1] * 4


def test_debris_is_a_surface_too(run: Path) -> None:
    moment = FrameSequence(run).moment(FRAMES - 1)
    saved = moment.saved
    saved.fragments[:30] = -1
    saved.positions[:30, 2] -= 1.0
    pieces = {piece.name: piece for piece in fragment_meshes(moment)}
    assert set(pieces) == {"debris", "fragment_0", "fragment_6"}
    for piece in pieces.values():
        mesh = piece.mesh()
        assert mesh.is_watertight and mesh.volume == pytest.approx(piece.volume, rel=0.02)


def test_colours_come_from_the_piece_itself(run: Path) -> None:
    moment = FrameSequence(run).moment(2)
    red, blue = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])
    upper = moment.fragment == int(moment.fragment.max())
    colors = torch.where(upper[:, None], red, blue)
    object.__setattr__(moment.saved, "gaussians", moment.gaussians.with_colors(colors))
    pieces = {piece.fragment: piece for piece in fragment_meshes(moment)}
    assert np.allclose(pieces[int(moment.fragment.max())].colors, red.numpy(), atol=0.02)
    assert np.allclose(pieces[0].colors, blue.numpy(), atol=0.02)


def test_obj_and_glb_hold_an_object_per_fragment(run: Path, tmp_path: Path) -> None:
    last = str(FRAMES - 1)
    write(run, tmp_path, mesh_ending="obj", frames=last)
    write(run, tmp_path, mesh_ending="glb", frames=last)
    truth = {piece.name: piece for piece in fragment_meshes(FrameSequence(run).moment(FRAMES - 1))}
    path = tmp_path / "meshes" / f"frame_{FRAMES:04d}.obj"
    text = path.read_text().splitlines()
    assert [line[2:] for line in text if line.startswith("o ")] == list(truth)
    whole = trimesh.load_mesh(path, process=False)
    assert [m.volume for m in whole.split()] == pytest.approx([HALF] * 2, rel=0.02)
    colors = np.concatenate([piece.colors for piece in truth.values()])
    assert np.abs(whole.visual.vertex_colors[:, :3] / 255 - colors).max() < 0.01
    scene = trimesh.load(tmp_path / "meshes" / f"frame_{FRAMES:04d}.glb", process=False)
    assert set(scene.geometry) == set(truth)
    for name, mesh in scene.geometry.items():
        piece: Piece = truth[name]
        assert mesh.is_watertight
        # +y is up, and glTF's colours are linear light
        assert np.allclose(mesh.vertices[:, 1], piece.vertices[:, 2], atol=1e-6)
        assert np.allclose(mesh.vertices[:, 2], -piece.vertices[:, 1], atol=1e-6)
        shown = mesh.visual.vertex_colors[:, :3] / 255
        linear = np.where(
            piece.colors <= 0.04045, piece.colors / 12.92, ((piece.colors + 0.055) / 1.055) ** 2.4
        )
        assert np.abs(shown - linear).max() < 0.01


def test_usd_shows_a_fragment_while_it_exists(run: Path, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    write(run, tmp_path, "usd", usd_parts=("meshes",))
    stage = usd.Stage.Open(str(tmp_path / "scene.usdc"))
    prims = {
        prim.GetName(): UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)
    }
    assert set(prims) == {"fragment_0", "fragment_6"}
    for time in range(1, FRAMES + 1):
        for name, mesh in prims.items():
            there = name == "fragment_0" or time > 2
            seen = mesh.ComputeVisibility(float(time)) == UsdGeom.Tokens.inherited
            assert seen == there
            if there:
                faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(float(time))).reshape(-1, 3)
                points = np.array(mesh.GetPointsAttr().Get(float(time)), np.float64)
                whole = trimesh.Trimesh(points, faces, process=False)
                assert whole.is_watertight
                assert whole.volume == pytest.approx(2 * HALF if time < 3 else HALF, rel=0.02)
                colors = mesh.GetDisplayColorPrimvar().Get(float(time))
                assert len(colors) == len(points)


def test_requests_that_cannot_be(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="obj"):
        write(run, tmp_path, mesh_ending="fbx")
    with pytest.raises(InputError, match="spacings"):
        write(run, tmp_path, mesh_blur=0.0)
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(InputError, match=r"gsfluent\[mesh\]"):
        write(run, tmp_path)
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"gsfluent\[usd\]"):
        write(run, tmp_path, "usd")
