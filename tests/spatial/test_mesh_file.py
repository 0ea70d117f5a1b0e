"""Mesh files: which they are, what belongs to them, and points on their coloured surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from gsfluent.colors import linear_to_srgb
from gsfluent.errors import InputError
from gsfluent.spatial.mesh_file import is_mesh, mesh_files, up_axes
from gsfluent.spatial.mesh_surface import surface_points


def painted_box(extents: tuple[float, float, float] = (1.0, 2.0, 3.0)) -> trimesh.Trimesh:
    """A box whose vertices are coloured by where they are: red along x, green along z."""
    box = trimesh.creation.box(extents)
    share = (box.vertices - box.bounds[0]) / np.ptp(box.bounds, axis=0)
    colors = np.full((len(box.vertices), 4), 255, np.uint8)
    colors[:, 0], colors[:, 1], colors[:, 2] = 255 * share[:, 0], 255 * share[:, 2], 0
    box.visual.vertex_colors = colors
    return box


@pytest.mark.parametrize("kind", ["obj", "ply", "glb"])
def test_points_lie_on_the_surface_in_its_colours(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"box.{kind}"
    painted_box().export(path)
    found = surface_points(path, 3000)
    half = np.array([0.5, 1.0, 1.5])
    assert np.abs(np.abs(found.points / half).max(axis=1) - 1.0).max() < 1e-5
    assert found.area == pytest.approx(22.0)
    face = np.abs(found.points / half).argmax(axis=1)
    normal = np.zeros_like(found.points)
    normal[np.arange(len(face)), face] = np.sign(found.points[np.arange(len(face)), face])
    assert (np.einsum("nc,nc->n", normal, found.normals) > 0.5).mean() > 0.99
    # every face has its share of the points
    assert np.bincount(face) / len(face) == pytest.approx([6 / 11, 3 / 11, 2 / 11], abs=0.01)
    assert found.colored
    share = found.points / (2 * half) + 0.5
    wanted = np.stack([share[:, 0], share[:, 2], 0 * face], 1)
    # glTF keeps the colours of vertices linear
    wanted = linear_to_srgb(wanted) if kind == "glb" else wanted
    assert np.abs(found.colors - wanted).max() < 0.03


def test_a_texture_is_looked_up_where_it_is_glued(tmp_path: Path) -> None:
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :, 0], picture[32:, :, 2] = 255, 255  # red above, blue below
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    square = trimesh.Trimesh(
        np.column_stack([uv, np.zeros(4)]), [[0, 1, 2], [0, 2, 3]], process=False
    )
    paint = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    square.visual = trimesh.visual.TextureVisuals(uv, material=paint)
    square.export(tmp_path / "square.glb")
    found = surface_points(tmp_path / "square.glb", 500)
    height = found.points[:, 1]  # textures repeat: the seam at 0 and 1 is a mixture
    above, below = (height > 0.55) & (height < 0.98), (height < 0.45) & (height > 0.02)
    assert np.allclose(found.colors[above], [1, 0, 0], atol=0.02)
    assert np.allclose(found.colors[below], [0, 0, 1], atol=0.02)


def test_what_has_no_colours_says_so(tmp_path: Path) -> None:
    trimesh.creation.icosphere(1).export(tmp_path / "ball.stl")
    found = surface_points(tmp_path / "ball.stl", 100)
    assert not found.colored and np.ptp(found.colors) == 0.0


def test_a_ply_is_a_mesh_when_it_has_faces(tmp_path: Path) -> None:
    painted_box().export(tmp_path / "box.ply")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    assert is_mesh(tmp_path / "box.ply") and not is_mesh(tmp_path / "points.ply")
    assert is_mesh(tmp_path / "any.STL") and not is_mesh(tmp_path / "shot.yaml")
    with pytest.raises(InputError, match="points"):
        surface_points(tmp_path / "points.ply", 10)


def test_textures_belong_to_an_obj(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\n")
    (tmp_path / "a.mtl").write_text("newmtl m\n  map_Kd skin.png\nmap_Ka gone.png\n")
    (tmp_path / "skin.png").write_bytes(b"x")
    names = [path.name for path in mesh_files(tmp_path / "a.obj")]
    assert names == ["a.obj", "a.mtl", "skin.png"]


def test_only_some_formats_say_what_is_up() -> None:
    assert up_axes("a.glb")[0] == (pytest.approx([0, 1, 0]), True)
    assert up_axes("a.obj")[0] == (pytest.approx([0, 1, 0]), False)
    assert up_axes("a.stl")[0] == (pytest.approx([0, 0, 1]), False)
