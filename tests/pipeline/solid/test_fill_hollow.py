"""Fill: hollow things, other sources than splats, walls, leaks and degenerate splats."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from interior_shapes import ellipsoid_shell
from torch import Tensor

from gsfluent import demo
from gsfluent.cli import main
from gsfluent.data import SURFACE, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.io import load_capture
from gsfluent.io.solid import load_solid
from gsfluent.pipeline import find_solid
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.solid.hollow import cavity_volume, hidden_cavity
from gsfluent.pipeline.solid.inside import find_leaks
from gsfluent.pipeline.solid.splats import _hollowed
from gsfluent.pipeline.solid.tsdf import Fused
from gsfluent.pipeline.solid.vote import Closed
from gsfluent.spatial.density import GridBox
from gsfluent.spatial.winding import winding_numbers


def discs(mesh: trimesh.Trimesh, count: int) -> Gaussians:
    """Flat splats on the surface of a mesh, that close it."""
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    normal = torch.from_numpy(mesh.face_normals[face].copy()).float()
    quats = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], 0 * normal[:, 0]], 1)
    quats[normal[:, 2] < -0.999] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    radius = math.sqrt(mesh.area / count)
    scales = torch.tensor([0.7 * radius, 0.7 * radius, 0.15 * radius]).repeat(count, 1)
    return Gaussians.from_colors(
        torch.from_numpy(points.copy()).float(),
        scales,
        torch.full((count, 3), 0.5),
        opacities=0.95,
        quats=quats,
    )


def lathe(profile: list[tuple[float, float]]) -> trimesh.Trimesh:
    """A body of revolution around z from (radius, height) along its closed section."""
    return trimesh.creation.revolve(np.array(profile), sections=96)


# section of a cup of radius 1, height 1.2, wall and floor 0.15
CUP = [(0, 0), (1, 0), (1, 1.2), (0.85, 1.2), (0.85, 0.15), (0, 0.15)]


def in_cup(p: Tensor) -> Tensor:
    radius, z = p[:, :2].norm(dim=1), p[:, 2]
    outer = (radius <= 1.0) & (z >= 0) & (z <= 1.2)
    return outer & ~((radius < 0.85) & (z > 0.15))


def in_pipe(p: Tensor) -> Tensor:
    radius = p[:, :2].norm(dim=1)
    return (radius <= 0.6) & (radius >= 0.4) & (p[:, 2].abs() <= 1.0)


def overlap(solid: Solid, inside: object) -> float:
    grid = torch.ones_like(solid.occupancy).nonzero()
    true = inside(solid.voxel_centers(grid)).reshape(solid.occupancy.shape)  # type: ignore[operator]
    return float((true & solid.occupancy).sum()) / float((true | solid.occupancy).sum())


@pytest.fixture(scope="module")
def cup() -> Solid:
    return Fill(56, refine_views=0)(discs(lathe(CUP), 14_000))


def test_a_cup_stays_empty_and_says_what_it_holds(cup: Solid) -> None:
    assert overlap(cup, in_cup) > 0.82  # discs overhang its rim
    assert cup.report["cavity_volume"] == pytest.approx(math.pi * 0.85**2 * 1.05, rel=0.1)
    assert cup.report["wall"]["median"] == pytest.approx(0.15, rel=0.25)
    assert "look into" in cup.report["why"]


def test_thin_walls_take_finer_voxels() -> None:
    splats = discs(lathe(CUP), 14_000)
    fine = Fill(30, refine_views=0)(splats)  # the wall is two voxels of these
    assert fine.report["finer"] > 1.5 and fine.voxel < 2.0 / 30 / 1.5
    plain = Fill(30, finer=False, refine_views=0)(splats)
    assert plain.voxel > 2.0 / 32
    assert overlap(fine, in_cup) > overlap(plain, in_cup)


def test_none_fills_it_and_a_number_hollows_it() -> None:
    splats = discs(lathe(CUP), 8000)
    full = Fill(40, hollow="none", refine_views=0)(splats)
    assert full.volume == pytest.approx(math.pi * 1.2, rel=0.15)
    assert full.report["cavity_volume"] < 0.05 * full.volume
    ball = ellipsoid_shell(2500, (1.0, 1.0, 1.0))
    shell = Fill(48, hollow=0.2, match_masks=False)(ball)
    assert shell.report["cavity_volume"] == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=0.12)
    assert shell.report["wall"]["median"] == pytest.approx(0.2, rel=0.25)
    # a closed cavity that nobody saw is never guessed
    assert Fill(48, match_masks=False)(ball).report["cavity_volume"] < 0.02


def test_a_pipe_is_open_at_both_ends() -> None:
    mesh = trimesh.creation.annulus(0.4, 0.6, 2.0, sections=96)
    pipe = Fill(56, refine_views=0)(discs(mesh, 10_000))
    assert overlap(pipe, in_pipe) > 0.77  # discs overhang the edges of both ends
    axis = torch.zeros(21, 3)
    axis[:, 2] = torch.linspace(-1.2, 1.2, 21)
    assert not bool(pipe.contains(axis).any())


def test_water_stays_below_the_lowest_way_out() -> None:
    body = np.ones((12, 12, 12), bool)
    body[2:10, 2:10, 4:] = False  # 8 x 8 wide, 8 deep
    assert cavity_volume(body, 0.5) == 8 * 8 * 8 * 0.5**3
    notched = body.copy()
    notched[5, :2, 7:] = False  # a spout three layers above the floor
    assert cavity_volume(notched, 1.0) == 8 * 8 * 3
    holed = body.copy()
    holed[5, 5, :4] = False
    # on its side it still holds what stands above neither opening
    assert cavity_volume(holed, 1.0) < 8 * 8 * 8
    assert cavity_volume(np.ones((5, 5, 5), bool), 1.0) == 0.0
    hidden = np.ones((9, 9, 9), bool)
    hidden[3:6, 3:6, 3:6] = False
    assert cavity_volume(hidden, 1.0) == 27.0


def test_behind_a_mouth_the_wall_goes_on_as_thick_as_it_was_seen() -> None:
    closed = np.zeros((40, 40, 60), bool)
    closed[4:36, 4:36, 4:56] = True
    body = closed.copy()
    body[8:32, 8:32, 40:56] = False  # what was looked into: walls of four
    seen = np.zeros_like(closed)
    seen[:, :, 41:] = True  # its floor, at 39, is where the view ended
    taken, found = hidden_cavity(body, closed, seen)
    assert found["wall"] == pytest.approx(4.0, abs=1.0)
    rest = body & ~taken
    true = closed.copy()
    true[8:32, 8:32, 8:56] = False
    assert (rest & true).sum() / (rest | true).sum() > 0.85
    # all of it seen: nothing is guessed
    assert hidden_cavity(body, closed, np.ones_like(closed))[1] == {}
    assert hidden_cavity(closed, closed, seen)[1] == {}


def _dimpled(depth: int, closed_side: list[float] | None) -> tuple[np.ndarray, str | None]:
    """A block with a pit of some depth whose floor nobody saw, after the guess about it."""
    closed = np.zeros((40, 40, 60), bool)
    closed[4:36, 4:36, 4:56] = True
    body = closed.copy()
    body[8:32, 8:32, 56 - depth : 56] = False
    near = np.zeros_like(closed)
    near[:, :, 57 - depth :] = True
    box = GridBox((0.0, 0.0, 0.0), 1.0, (40, 40, 60))
    notes = {"closed_side": closed_side}
    fused = Fused(np.zeros(body.shape, np.float32), near, near)
    block = Closed(box, closed, closed, closed, None, notes)
    result, word = _hollowed(body, block, fused, torch.device("cpu"))
    return body & ~result, word


def test_a_vessel_is_hollowed_on_and_a_dimple_is_not() -> None:
    taken, word = _dimpled(18, None)
    assert taken.any() and word is not None and "as thick" in word
    # an apple: its dimple's floor was hidden, or its underside was never photographed
    for depth, side in ((10, None), (18, [0.0, 0.0, -1.0])):
        taken, word = _dimpled(depth, side)
        assert not taken.any()
        assert word is not None and "solid where no camera looked" in word


def test_leaks_are_told_with_place_and_size() -> None:
    shell = np.zeros((24, 24, 24), bool)
    shell[4:20, 4:20, 4:20] = True
    shell[5:19, 5:19, 5:19] = False
    inside = np.zeros_like(shell)
    inside[4:20, 4:20, 4:20] = True
    shell[8:12, 8:11, 19] = False
    found = find_leaks(shell, inside, np.array([-1.0, 0.0, 0.0]), 0.1)
    assert found["leaks"] == 1 and len(found["leak_list"]) == 1
    assert found["leak_list"][0]["area"] == pytest.approx(12 * 0.01)
    assert found["leak_list"][0]["center"] == pytest.approx([0.0, 0.95, 1.95])
    assert find_leaks(inside, inside, np.zeros(3), 1.0)["leak_list"] == []


def _one_more(kind: str) -> Gaussians:
    size = {"zero": 0.0, "needle": 1e-15, "huge": 1e9, "quaternion": 0.02}[kind]
    quat = torch.zeros(1, 4) if kind == "quaternion" else torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    return Gaussians.from_colors(
        torch.tensor([[0.3, 0.1, 0.3]]),
        torch.full((1, 3), size),
        torch.full((1, 3), 0.5),
        opacities=0.9,
        quats=quat,
    )


@pytest.mark.parametrize("kind", ["zero", "needle", "huge", "quaternion"])
def test_one_degenerate_covariance_changes_nothing(kind: str) -> None:
    # PhysGaussian and GaussianFluent, by their own account, hang or fail on one of these
    clean = ellipsoid_shell(1000)
    plain = Fill(24)(clean)
    dirty = Fill(24)(Gaussians.cat([clean, _one_more(kind)]))
    assert torch.equal(plain.origin, dirty.origin)
    different = plain.occupancy ^ dirty.occupancy
    assert int(different.sum()) <= (8 if kind == "needle" else 0)
    assert dirty.report["unusable_gaussians"] == (0 if kind == "needle" else 1)


def test_a_mesh_says_what_is_matter() -> None:
    mesh = lathe(CUP)
    alone = Fill(48, refine_views=0)(solid=mesh)
    assert alone.report["method"] == "mesh" and overlap(alone, in_cup) > 0.95
    skin = alone.gaussians.select(alone.gaussians.labels == SURFACE)
    assert skin.count > 500
    exact = find_solid(mesh=mesh, resolution=48)
    assert float(exact.at(skin.means).abs().max()) < alone.voxel
    splats = ellipsoid_shell(600)
    both = Fill(48, refine_views=0)(splats, solid=exact)
    assert torch.equal(both.occupancy, alone.occupancy)
    assert int((both.gaussians.labels == SURFACE).sum()) == 600
    with pytest.raises(InputError, match="neither"):
        Fill(32)()


def test_masks_alone_make_a_solid_in_the_colours_of_the_photographs(tmp_path: Path) -> None:
    paths = demo.make_capture("watermelon", tmp_path / "melon", views=10, size=64)
    out = tmp_path / "solid.ply"
    code = main(["fill", str(paths.root), "-o", str(out), "--resolution", "32"])
    assert code == 0
    solid = load_solid(out)
    truth = demo.make_object("watermelon", 0)
    assert overlap(solid, lambda p: truth.inside(p.double())) > 0.9
    skin = solid.gaussians.select(solid.gaussians.labels == SURFACE).colors().mean(0)
    pictures = [load_capture(paths.root).view(i, 64) for i in range(0, 10, 3)]
    seen = torch.stack([(v.image[v.mask > 0.9]).mean(0) for v in pictures]).mean(0)
    assert float((skin - seen).abs().max()) < 0.1
    assert solid.report["method"] == "hull"


def test_winding_numbers_are_one_inside_and_a_half_on_the_lid_of_a_hemisphere() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    points = torch.from_numpy(ball.triangles_center.copy()).float()
    areas = torch.from_numpy(ball.face_normals * ball.area_faces[:, None]).float()
    queries = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.3, 0.2], [1.5, 0.0, 0.0], [9.0, 9.0, 9.0]])
    found = winding_numbers(queries, points, areas)
    assert found.tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0], abs=0.01)
    lower = points[:, 2] < 0
    # seen from the middle of its rim a hemisphere takes half of the sphere of directions
    half = winding_numbers(torch.zeros(1, 3), points[lower], areas[lower])
    assert float(half) == pytest.approx(0.5, abs=0.03)
    with pytest.raises(ValueError, match="both"):
        winding_numbers(queries, points, areas[:3])


def test_an_open_mesh_is_closed_by_its_winding_numbers() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.update_faces(ball.triangles_center[:, 2] > -0.9)
    ball.remove_unreferenced_vertices()
    field = find_solid(mesh=ball, resolution=28)
    assert field.volume == pytest.approx(4 / 3 * math.pi, rel=0.03)
    assert field.report["closed_by"] == "winding numbers" and field.report["leaks"] >= 1
    assert field.report["leak_list"][0]["center"][2] < -0.8
