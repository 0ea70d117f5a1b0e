"""The object's solid: distances, sources, closed meshes, thin walls; truth is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from interior_shapes import ellipsoid_shell
from torch import Tensor

from gsfluent import demo
from gsfluent.cli import main
from gsfluent.data import BACKGROUND, SURFACE, Gaussians
from gsfluent.errors import InputError
from gsfluent.io import load_capture
from gsfluent.io.splats.load import save_splats
from gsfluent.pipeline.solid.field import SignedDistance, distances_of
from gsfluent.pipeline.solid.mesh import closed_mesh, mesh_to, save_mesh
from gsfluent.pipeline.solid.outline import match_outline
from gsfluent.pipeline.solid.source import find_solid
from gsfluent.pipeline.solid.tsdf import ring_of_cameras, zoomed
from gsfluent.pipeline.solid.walls import thin_shells, wall_thickness
from gsfluent.spatial.mesh_file import load_mesh


def discs(mesh: trimesh.Trimesh, count: int = 30_000) -> Gaussians:
    """Flat splats on the surface of a mesh, that just close it."""
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    normal = torch.from_numpy(mesh.face_normals[face].copy()).float()
    quats = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], 0 * normal[:, 0]], 1)
    quats[normal[:, 2] < -0.999] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    radius = math.sqrt(mesh.area / count)
    scales = torch.tensor([0.5 * radius, 0.5 * radius, 0.15 * radius]).repeat(count, 1)
    colors = torch.full((count, 3), 0.5)
    means = torch.from_numpy(points.copy()).float()
    return Gaussians.from_colors(means, scales, colors, opacities=0.95, quats=quats)


def overlap(field: SignedDistance, inside: Any, low: float = -1.6, high: float = 1.6) -> float:
    """Intersection over union with a true inside, at random points."""
    draw = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1))
    points = low + (high - low) * draw
    guess, true = field.at(points) <= 0, inside(points)
    return float((guess & true).sum()) / float((guess | true).sum())


def in_torus(p: Tensor) -> Tensor:
    return (p[:, :2].norm(dim=1) - 1.0).square() + p[:, 2].square() <= 0.4**2


def in_box(p: Tensor) -> Tensor:
    return (p.abs() <= torch.tensor([0.5, 0.35, 0.25])).all(1)


def in_ball(p: Tensor) -> Tensor:
    return p.norm(dim=1) <= 1.0


SHAPES = {
    "ball": (trimesh.creation.icosphere(subdivisions=4), in_ball, 4.0 / 3.0 * math.pi),
    "torus": (
        trimesh.creation.torus(1.0, 0.4, major_sections=96, minor_sections=48),
        in_torus,
        2.0 * math.pi**2 * 0.16,
    ),
    "box": (trimesh.creation.box((1.0, 0.7, 0.5)), in_box, 0.35),
}


@pytest.mark.parametrize(("name", "resolution"), [("torus", 72), ("box", 48), ("ball", 40)])
@pytest.mark.parametrize(
    ("method", "least", "volume"),
    # discs overhang edges and look thicker than the surface that they lie on
    [("mesh", 0.97, 0.02), ("density", 0.90, 0.12), ("tsdf", 0.90, 0.10)],
)
def test_known_shapes_are_found(
    name: str, resolution: int, method: str, least: float, volume: float
) -> None:
    mesh, inside, true = SHAPES[name]
    if method == "mesh":
        field = find_solid(mesh=mesh, resolution=resolution)
    else:
        field = find_solid(discs(mesh, 10_000), method=method, resolution=resolution)
    assert overlap(field, inside) >= least
    assert field.volume == pytest.approx(true, rel=volume)
    assert field.source == method and field.report["seconds"] > 0


@pytest.mark.parametrize("shrunk", [-0.5, 0.0, 1.3])
def test_the_skin_is_put_where_the_outlines_are(shrunk: float) -> None:
    mesh, inside, true = SHAPES["torus"]
    exact = find_solid(mesh=mesh, resolution=64)
    wrong = exact.replace(values=exact.values + shrunk * exact.voxel)
    seen = []
    for camera in ring_of_cameras(torch.zeros(3), 1.5, 4):
        # what a camera sees of the true torus: rays sampled every hundredth
        row, column = torch.meshgrid(torch.arange(128), torch.arange(128), indexing="ij")
        small = camera.resized(128, 128)
        x = (column + 0.5 - float(small.K[0, 2])) / float(small.K[0, 0])
        y = (row + 0.5 - float(small.K[1, 2])) / float(small.K[1, 1])
        ray = torch.stack([x, y, torch.ones_like(x)], -1) @ small.viewmat[:3, :3].float()
        along = torch.linspace(4.0, 8.0, 250)
        hit = torch.zeros(128, 128, dtype=torch.bool)
        for part in along.split(50):
            points = small.center().float() + ray[..., None, :] * part[:, None]
            hit |= inside(points.reshape(-1, 3)).reshape(128, 128, -1).any(-1)
        seen.append((small, hit))
    matched, offset = match_outline(wrong, seen)
    assert offset == pytest.approx(shrunk, abs=0.25)
    assert matched.volume == pytest.approx(true, rel=0.03)
    assert match_outline(wrong, [])[1] == 0.0


def test_distances_are_those_of_a_ball() -> None:
    axis = torch.arange(40) + 0.5 - 20
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    radius = (x**2 + y**2 + z**2).sqrt()
    field = SignedDistance.of_voxels((radius <= 12.0).numpy(), np.full(3, -20.0), 1.0, "test")
    points = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    points = points / points.norm(dim=1, keepdim=True) * torch.linspace(4, 30, 2000)[:, None]
    error = (field.at(points) - (points.norm(dim=1) - 12.0)).abs()
    # half a voxel of the stairs; off the grid (beyond 15) it is a bound from above
    assert float(error[points.norm(dim=1) < 15].max()) < 0.75
    far = points.abs().amax(1) > 15
    assert bool((field.at(points)[far] >= points[far].norm(dim=1) - 12.0 - 0.75).all())
    assert field.volume == pytest.approx(4 / 3 * math.pi * 12**3, rel=0.01)


def test_crumbs_and_bubbles_go_and_the_rest_stays() -> None:
    body = np.zeros((30, 30, 30), bool)
    body[5:20, 5:20, 5:20] = True
    body[10:12, 10:12, 10:12] = False  # a bubble
    body[25, 25, 25] = True  # a crumb
    body[22:27, 8:13, 8:13] = True  # a piece of 4 %
    field = SignedDistance.of_voxels(body, np.zeros(3), 1.0, "test")
    tidy = field.tidied()
    change = tidy.inside.int() - field.inside.int()
    assert int(change.clamp_min(0).sum()) == 8 and int((-change).clamp_min(0).sum()) == 1
    mesh = closed_mesh(tidy)
    assert mesh.body_count == 2 and mesh.is_watertight
    assert torch.equal(tidy.values[change == 0], field.values[change == 0])


def test_smoothing_moves_no_voxel_to_the_other_side() -> None:
    noise = np.random.default_rng(0).random((24, 24, 24)) < 0.3
    assert np.array_equal(distances_of(noise) <= 0, noise)
    assert np.all(np.isposinf(distances_of(np.zeros((4, 4, 4), bool))))


@pytest.mark.parametrize("name", SHAPES)
def test_the_mesh_is_closed_wound_outward_and_of_the_right_volume(name: str) -> None:
    mesh, inside, true = SHAPES[name]
    found = closed_mesh(find_solid(discs(mesh, 8000), method="density", resolution=48))
    assert found.is_watertight and found.is_winding_consistent
    assert found.volume == pytest.approx(true, rel=0.15)  # negative if it were wound inward
    assert found.euler_number == (0 if name == "torus" else 2)
    step = 0.05 * torch.from_numpy(found.face_normals.copy()).float()
    middle = torch.from_numpy(found.triangles_center.copy()).float()
    assert float(inside(middle + step).float().mean()) < 0.2
    assert float(inside(middle - step).float().mean()) > 0.9


def test_random_voxels_give_closed_meshes() -> None:
    from scipy import ndimage

    for seed in range(4):
        noise = np.random.default_rng(seed).random((20, 20, 20))
        body = ndimage.gaussian_filter(noise, 1.2) > 0.5
        mesh = closed_mesh(SignedDistance.of_voxels(body, np.zeros(3), 0.1, "test"))
        assert mesh.is_watertight and mesh.volume > 0


def test_vertices_wear_the_colours_of_the_splats_next_to_them(tmp_path: Path) -> None:
    red_above = ellipsoid_shell(
        3000, color=lambda p: torch.where(p[:, 2:] > 0, torch.tensor([0.9, 0.1, 0.1]), 0.2)
    )
    mesh = closed_mesh(find_solid(red_above, method="density", resolution=48), red_above)
    color = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
    above = np.asarray(mesh.vertices)[:, 2] > 0.2
    assert np.abs(color[above].mean(0) - [0.9, 0.1, 0.1]).max() < 0.05
    for kind in ("obj", "ply", "glb", "stl"):
        save_mesh(mesh, tmp_path / f"out.{kind}", scale=2.0)
        back = load_mesh(tmp_path / f"out.{kind}")
        assert back.is_watertight
        assert back.volume == pytest.approx(8 * mesh.volume, rel=1e-3)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".glb", ".obj", ".ply", ".stl"]


def test_a_cavity_that_cameras_look_into_is_not_closed() -> None:
    # a cup: rays from within meet its wall all around, cameras from above see its bottom
    outer = trimesh.creation.cylinder(0.8, 1.6, sections=64)
    inner = trimesh.creation.cylinder(0.6, 1.4, sections=64)
    inner.apply_translation((0.0, 0.0, 0.1))
    inner.invert()
    top = np.isclose(inner.triangles_center[:, 2], 0.8)
    inner.update_faces(~top)
    lid = np.isclose(outer.triangles_center[:, 2], 0.8)
    outer.update_faces(~lid)
    ring = trimesh.creation.annulus(0.6, 0.8, 1e-4, sections=64)
    ring.apply_translation((0.0, 0.0, 0.8))
    cup = discs(trimesh.util.concatenate([outer, inner, ring]), 15_000)
    field = find_solid(cup, method="tsdf", resolution=48)
    hollow = torch.tensor([[0.0, 0.0, 0.3], [0.3, 0.0, 0.0], [0.0, 0.0, -0.4]])
    wall = torch.tensor([[0.7, 0.0, 0.0], [0.0, -0.7, 0.3], [0.0, 0.0, -0.7]])
    assert bool((field.at(hollow) > 0).all())
    assert bool((field.at(wall) <= 0).all())
    closed = find_solid(cup, method="density", resolution=48)
    assert float(closed.at(hollow[2:])) < 0  # the vote alone cannot know


def test_masks_alone_give_the_hull_and_splats_win_over_it(tmp_path: Path) -> None:
    paths = demo.make_capture("watermelon", tmp_path, views=12, size=64)
    capture = load_capture(paths.root)
    field = find_solid(None, capture, resolution=48)
    assert field.source == "hull" and field.report["why"] == "masks and no splats"
    truth = demo.make_object("watermelon", 0)
    lower, upper = truth.bounds()
    draw = torch.rand(50_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = lower + draw * (upper - lower)
    true, guess = truth.inside(points), field.at(points.float()) <= 0
    assert float((true & guess).sum()) / float((true | guess).sum()) > 0.9


def test_an_open_mesh_is_closed_by_the_vote() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.update_faces(ball.triangles_center[:, 2] > -0.8)
    assert not ball.is_watertight
    field = find_solid(mesh=ball, resolution=40)
    assert not field.report["watertight"] and field.report["leaks"] >= 1
    # the voxels that hold the surface count in full, and the cap below is closed flat
    assert overlap(field, in_ball) > 0.91


@pytest.mark.parametrize("wall", [0.10, 0.25])
def test_wall_thickness_of_a_hollow_ball(wall: float) -> None:
    axis = (torch.arange(100) + 0.5) * 0.025 - 1.25
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    radius = (x**2 + y**2 + z**2).sqrt()
    values = torch.maximum(radius - 1.0, (1.0 - wall) - radius)
    field = SignedDistance(values, torch.full((3,), -1.25), 0.025, "test")
    _, thickness = wall_thickness(field, 0.6)
    assert float(thickness.median()) == pytest.approx(wall, rel=0.1)
    report = thin_shells(field, 0.08, gaussian_size=0.2)
    if wall < 0.24:
        assert report["share"] > 0.95 and "finer" in report["hint"]
        assert report["cells_needed"] == pytest.approx(0.24 / wall, rel=0.2)
        assert report["cells"] == pytest.approx(wall / 0.08, rel=0.2)
    else:
        assert report["share"] < 0.05 and report["warning"] is None


def test_a_full_ball_is_nowhere_thin() -> None:
    field = find_solid(mesh=trimesh.creation.icosphere(subdivisions=3), resolution=48)
    report = thin_shells(field, 2.0 / 40)
    assert report["share"] == 0.0 and report["warning"] is None and report["thinnest"] is None
    with pytest.raises(ValueError, match="cell"):
        thin_shells(field, 0.0)


def test_cameras_are_zoomed_to_the_object_without_moving() -> None:
    for camera in ring_of_cameras(torch.zeros(3), 1.0, 6):
        near = zoomed(camera.replace(width=4000, height=3000), torch.zeros(3), 0.5)
        assert near is not None and torch.equal(near.viewmat, camera.viewmat)
        rim = torch.tensor([[0.5, 0, 0], [0, 0.5, 0], [0, 0, -0.5]], dtype=torch.float64)
        pixel, depth = near.project(rim)
        assert bool((depth > 0).all()) and bool((pixel > 0).all() & (pixel < near.width).all())
    away = ring_of_cameras(torch.tensor([9.0, 0.0, 0.0]), 0.5, 4)[0]
    assert zoomed(away, torch.zeros(3), 0.5) is None


def test_the_verb_writes_a_mesh_and_leaves_the_background_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = ellipsoid_shell(3000)
    wall = ellipsoid_shell(500).replace(means=ellipsoid_shell(500).means + 5.0)
    both = Gaussians.cat([
        shell.replace(labels=torch.full((shell.count,), SURFACE, dtype=torch.int32)),
        wall.replace(labels=torch.full((wall.count,), BACKGROUND, dtype=torch.int32)),
    ])  # fmt: skip
    save_splats(both, tmp_path / "in.ply")
    out = tmp_path / "out.glb"
    assert main(["mesh", str(tmp_path / "in.ply"), "-o", str(out), "--resolution", "48"]) == 0
    assert "watertight: yes" in capsys.readouterr().out
    mesh = load_mesh(out)
    assert mesh.is_watertight and float(np.asarray(mesh.vertices).max()) < 1.5
    again = mesh_to(out, tmp_path / "again.stl", resolution=48)
    assert again["source"] == "mesh" and again["volume"] == pytest.approx(mesh.volume, rel=0.02)


def test_what_cannot_be_is_refused(tmp_path: Path, without: Callable[[str], None]) -> None:
    shell = ellipsoid_shell(500)
    with pytest.raises(InputError, match="neither splats"):
        find_solid()
    with pytest.raises(InputError, match="needs a capture with masks"):
        find_solid(shell, method="hull")
    with pytest.raises(InputError, match="not known"):
        find_solid(shell, method="poisson")
    with pytest.raises(InputError, match="resolution"):
        find_solid(shell, resolution=4)
    with pytest.raises(InputError, match="end the name"):
        mesh_to(tmp_path / "in.ply", tmp_path / "out.usd")
    empty = SignedDistance(torch.ones(4, 4, 4), torch.zeros(3), 1.0, "test")
    with pytest.raises(InputError, match="empty"):
        closed_mesh(empty)
    without("skimage")
    with pytest.raises(InputError, match=r"gsfluent\[mesh\]"):
        closed_mesh(empty.replace(values=-torch.ones(4, 4, 4)))


@pytest.mark.data
def test_scanned_meshes_are_found_again_from_splats_on_them(data_root: Path) -> None:
    scan = load_mesh(data_root / "meshes" / "mango" / "mango-v1.glb")
    assert scan.is_watertight  # its texture has seams; the surface has none
    truth = find_solid(mesh=scan, resolution=64)
    field = find_solid(discs(scan, 15_000), method="density", resolution=64)
    low, high = float(scan.bounds.min()), float(scan.bounds.max())
    assert overlap(field, lambda p: truth.at(p) <= 0, low, high) > 0.9
