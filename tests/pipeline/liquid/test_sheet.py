"""Splats of liquids: flat in films, round inside and in spray, and carried along by a turn."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.data import Particles
from gsfluent.geometry import covariance, quaternion_to_matrix
from gsfluent.pipeline.colliders.splats import _drops, bare_splats
from gsfluent.pipeline.liquid.sheet import CLOSED, FILM, RATIO, SPRAY, TENSION, TORN, ellipsoids
from gsfluent.pipeline.liquid.spacing import apart
from gsfluent.pipeline.liquid.tearing import WETS, in_air, tears
from gsfluent.scene.scene import Scene
from gsfluent.spatial.blue_noise import blue_cylinder
from gsfluent.spatial.neighbours import nearest_rows

H = 0.002
VOLUME = H**3


def film(distance: float, seed: int = 0) -> Tensor:
    """A flat film 36 points wide with a point at every ``distance`` spacings, roughened."""
    generator = torch.Generator().manual_seed(seed)
    row = torch.arange(36, dtype=torch.float64)
    points = torch.stack([*torch.meshgrid(row, row, indexing="ij"), 0 * row.expand(36, 36)], -1)
    noise = 0.3 * (torch.rand(36, 36, 3, generator=generator, dtype=torch.float64) - 0.5)
    return ((points + noise) * distance * H).reshape(-1, 3)


def middle(points: Tensor) -> Tensor:
    """Points away from the edge."""
    low, high = points.amin(dim=0), points.amax(dim=0)
    inside = ((points > low + 8 * H) & (points < high - 8 * H))[:, :2].all(dim=1)
    return inside.nonzero()[:, 0]


@pytest.mark.parametrize("distance", [1.2, 1.6, 2.2])
def test_a_film_is_closed_flat_and_as_thick_as_its_volume(distance: float) -> None:
    points = film(distance)
    drawn = ellipsoids(points, points.new_full(points.shape[:1], VOLUME))
    rows = middle(points)
    scales = drawn.scales[rows]
    normal = quaternion_to_matrix(drawn.quats[rows])[:, :, 2]
    assert float(normal[:, 2].abs().min()) > 0.97
    assert torch.all(scales[:, 0] >= scales[:, 1]) and torch.all(scales[:, 1] >= scales[:, 2])
    assert float((scales[:, 0] / scales[:, 2]).max()) <= RATIO * (1 + 1e-6)
    assert float(scales[:, 1].min()) > 0.9 * FILM * distance * H
    free = scales[:, 2] > scales[:, 0] / RATIO * (1 + 1e-6)
    volume = scales[free].prod(dim=1)
    assert torch.allclose(volume, torch.full_like(volume, (CLOSED * H) ** 3), rtol=1e-6)
    # Rough points come back to their sheet.
    assert float(drawn.means[rows, 2].std()) < 0.3 * float(points[rows, 2].std())


def test_inside_and_spray_are_round() -> None:
    points = blue_cylinder(0.02, 0.04, H, seed=1)
    drawn = ellipsoids(points, points.new_full(points.shape[:1], VOLUME))
    deep = (points[:, :2].norm(dim=1) < 0.01) & (points[:, 2].abs() < 0.01)
    assert float((drawn.scales[deep, 0] / drawn.scales[deep, 2]).median()) < 1.35
    assert torch.allclose(drawn.means[deep], points[deep], atol=0.3 * H)
    lone = torch.cat([points, points.new_tensor([[0.3, 0.0, 0.0]])])
    last = ellipsoids(lone, lone.new_full(lone.shape[:1], VOLUME))
    assert torch.allclose(last.scales[-1], lone.new_full((3,), SPRAY * CLOSED * H))
    assert torch.equal(last.means[-1], lone[-1])
    few = ellipsoids(points[:5], points.new_full((5,), VOLUME))
    assert torch.allclose(few.scales, points.new_full((5, 3), SPRAY * CLOSED * H))


def test_splats_turn_with_their_points_and_know_no_order() -> None:
    generator = torch.Generator().manual_seed(2)
    points = film(1.4)[:600]
    volume = points.new_full((600,), VOLUME)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    turn = turn * torch.linalg.det(turn)
    order = torch.randperm(600, generator=generator)
    plain = ellipsoids(points, volume)
    turned = ellipsoids((points @ turn.T + 0.1)[order], volume)
    assert torch.allclose(turned.means, (plain.means @ turn.T + 0.1)[order], atol=1e-9)

    def matrices(quats: Tensor, scales: Tensor) -> Tensor:
        xx, yy, zz, xy, xz, yz = covariance(quats, scales).unbind(1)
        rows = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1)
        return rows.reshape(-1, 3, 3)

    there = turn @ matrices(plain.quats, plain.scales)[order] @ turn.T
    assert torch.allclose(matrices(turned.quats, turned.scales), there, atol=1e-3 * H**2)


def test_clumps_come_apart_and_their_middle_stays() -> None:
    generator = torch.Generator().manual_seed(4)
    points = torch.rand(800, 3, generator=generator, dtype=torch.float64)
    points = points * torch.tensor([28 * H, 28 * H, 0.2 * H])
    before = nearest_rows(points, points, 2, H)[0][:, 1]
    moved = points
    for _ in range(12):
        moved = apart(moved, H)
    after = nearest_rows(moved, moved, 2, H)[0][:, 1]
    assert float(after.quantile(0.1)) > 1.8 * float(before.quantile(0.1))
    assert torch.allclose(moved.mean(dim=0), points.mean(dim=0), atol=1e-12)
    order = torch.randperm(800, generator=generator)
    assert torch.equal(apart(points[order], H), apart(points, H)[order])
    even = blue_cylinder(0.02, 0.02, H, seed=1)
    assert float((apart(even, H) - even).norm(dim=1).mean()) < 0.02 * H


def test_a_thin_sheet_tears_in_air_and_not_on_a_solid() -> None:
    points = film(1.8, seed=3)
    free = torch.ones(len(points), dtype=torch.bool)

    def bare(place: Tensor) -> float:
        """Share of the sheet's places that are far from every point."""
        rows = middle(points)
        return float((nearest_rows(place, points[rows], 1, H)[0] > 1.2 * H).double().mean())

    torn = held = points
    for _ in range(25):
        torn, held = apart(torn, H, free), apart(held, H, ~free)
    assert torch.equal(held, apart_times(points, 25))
    assert torch.allclose(torn.mean(dim=0), points.mean(dim=0), atol=1e-12)
    # holes open between strands, whose points are nearer than they were
    assert bare(torn) > 0.05 and bare(held) < 0.01
    near = nearest_rows(torn, torn, 2, H)[0][:, 1]
    assert float(near.quantile(0.5)) < 1.0 * H
    volume = points.new_full((len(points),), VOLUME)
    rows = middle(points)
    drawn = ellipsoids(points, volume, free)
    assert float(drawn.scales[rows].max()) <= TORN * H * (1 + 1e-6)
    closed = ellipsoids(points, volume, ~free)
    assert torch.equal(closed.scales, ellipsoids(points, volume).scales)
    # a sheet that its points can carry does not tear
    whole = film(0.9)
    free = torch.ones(len(whole), dtype=torch.bool)
    inner = middle(whole)
    assert torch.equal(apart(whole, H, free)[inner], apart(whole, H)[inner])


def apart_times(points: Tensor, times: int) -> Tensor:
    for _ in range(times):
        points = apart(points, H)
    return points


def test_what_lies_on_the_floor_or_a_solid_is_not_in_air() -> None:
    height = torch.linspace(0.0, 20 * H, 41, dtype=torch.float64)
    points = torch.stack([0 * height, 0 * height, height], dim=1)
    nothing = points[:0]
    assert bool(in_air(points, nothing, H, None).all())
    assert torch.equal(in_air(points, nothing, H, 0.0), height > WETS * H)
    solid = points.new_tensor([[0.0, 0.0, 10.1 * H]])
    assert torch.equal(in_air(points, solid, H, None), (height - 10.1 * H).abs() > WETS * H)


def test_water_tears_and_what_holds_its_surface_does_not() -> None:
    assert tears(materials.get("water"))
    assert not any(tears(materials.get(name)) for name in ("milk", "oil", "honey"))


def test_drops_have_sizes_of_their_own() -> None:
    sizes = _drops(torch.ones(20000))
    assert torch.equal(sizes[:50], _drops(torch.ones(50)))  # for good, whatever comes later
    assert float(sizes.min()) > 0.3 and float(sizes.max()) < 1.7
    assert float(sizes.pow(3).mean()) == pytest.approx(1.0, abs=0.05)
    assert float(sizes.std()) > 0.2


def test_fine_points_alone_make_fewer_and_larger_drops() -> None:
    scene = Scene(floor=None)
    scene.pour((0.0, 0.0, 0.1), 1.0, 0.01, volume=1e-5, material="milk")
    edge = TENSION / 3.0
    position = 0.1 * torch.rand(20000, 3, generator=torch.Generator().manual_seed(1))
    volume = torch.full((20000,), edge**3)
    particles = Particles.at_rest(position, mass=1e3 * volume, volume=volume)
    drawn = bare_splats(particles, scene)
    assert drawn is not None
    drops = drawn.opacities > 0.9
    assert float(drops.float().mean()) == pytest.approx(1.0 / 27.0, rel=0.1)
    seen = (drawn.scales[drops] / (SPRAY * CLOSED)).prod(dim=1)
    assert float(drawn.opacities[~drops].mean()) < 0.02
    assert float(seen.sum()) == pytest.approx(20000 * edge**3, rel=0.1)
