"""Liquids in a picture: how much light goes through, what reflects, how smooth and sharp they are,
and that a gap in them is a hole."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.light.lamps import studio_light
from gsfluent.pipeline.liquid.clear import (
    Clear,
    Surface,
    covered,
    in_front,
    mirrored,
    single,
    smoothed,
    surface_normals,
)
from gsfluent.pipeline.liquid.sheet import ellipsoids
from gsfluent.pipeline.render.holes import Holes, MatterView
from gsfluent.pipeline.render.stage import Picture, Render
from gsfluent.spatial.blue_noise import blue_cylinder

H = 0.004
LETS = 30.0  # attenuation [1/m]


def camera() -> Camera:
    """Looks down on the origin from 2 m."""
    return Camera.look_at((0.0, -1e-3, 2.0), (0.0, 0.0, 0.0), width=160, height=160, fov=4.0)


def pool(deep: float, gap: float = 0.0) -> tuple[Tensor, Gaussians]:
    """Points of a round pool, and its splats but those within ``gap`` of the middle [m]."""
    points = blue_cylinder(0.06, deep, H, seed=3)
    drawn = ellipsoids(points, points.new_full(points.shape[:1], H**3))
    kept = drawn.means[:, :2].norm(dim=1) >= gap
    blue = drawn.means.new_tensor([0.2, 0.3, 0.9]).expand_as(drawn.means)[kept].float()
    made = Gaussians.from_colors(
        drawn.means[kept].float(), drawn.scales[kept].float(), blue, opacities=0.4
    )
    return points.float(), made.replace(quats=drawn.quats[kept].float())


def stone(below: float) -> Gaussians:
    """An opaque red plate, wider than the picture."""
    line = torch.arange(-0.08, 0.0801, 0.002)
    x, y = torch.meshgrid(line, line, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, -below)], -1).reshape(-1, 3)
    red = means.new_tensor([0.8, 0.1, 0.1]).expand_as(means).contiguous()
    return Gaussians.from_colors(means, torch.full((len(means),), 0.0015), red, opacities=0.98)


def drawn(
    water: Gaussians,
    *behind: Gaussians,
    lit: bool = False,
    clear: bool = True,
    attenuation: float = LETS,
) -> Picture:
    whole = Gaussians.cat([water, *behind])
    rows = torch.arange(whole.count) < water.count
    volume = torch.full((water.count,), H**3)
    told = Clear(rows, volume, torch.full_like(volume, attenuation), torch.tensor([0.9, 200.0]))
    stage = Render(camera(), studio_light() if lit else None)
    return stage(whole, clear=told if clear else None)


@pytest.mark.parametrize("deep", [0.02, 0.04])
def test_light_goes_through_by_beer_and_lambert(deep: float) -> None:
    """A stone under a pool keeps ``exp(-a t)`` of its colour, the pool adds the rest of its own."""
    _, water = pool(deep)
    seen = drawn(water, stone(0.5 * deep + 0.02)).image[60:100, 60:100].mean(dim=(0, 1))
    bare = Render(camera())(stone(0.5 * deep + 0.02)).image[60:100, 60:100].mean(dim=(0, 1))
    left = math.exp(-LETS * deep)
    wanted = left * bare + (1.0 - left) * torch.tensor([0.2, 0.3, 0.9])
    torch.testing.assert_close(seen, wanted, atol=0.04, rtol=0.0)


def test_water_is_no_hole_and_a_gap_in_it_is() -> None:
    """As glass, water is measured as solid; where splats of its points are missing, it is not."""
    points, water = pool(0.012)
    _, torn = pool(0.012, gap=0.02)
    matter = MatterView.of(points, torch.full((len(points),), H**3), camera())
    far = stone(1.0)
    far = far.replace(means=far.means + far.means.new_tensor([5.0, 0.0, 0.0]))  # out of the picture
    found = [Holes.of(p.alpha, p.depth, matter) for p in (drawn(water, far), drawn(torn, far))]
    through = drawn(water, far, clear=False)
    assert found[0].fraction < 2e-3
    # blended by one opacity the same water lets more through than a closed surface may
    assert Holes.of(through.alpha, through.depth, matter).fraction > found[0].fraction
    inner = (0.02 - 1.5 * H) ** 2 / 0.06**2  # splats reach into the gap
    assert inner < found[1].fraction < (0.02 + H) ** 2 / (0.06 - H) ** 2


def test_a_wet_surface_glints_and_what_is_before_it_hides_it() -> None:
    _, water = pool(0.012)
    wet = drawn(water, stone(0.03), lit=True).image
    dry = Render(camera(), studio_light())(stone(0.03)).image
    assert float((wet - dry).abs().mean()) > 0.02
    lid = stone(-0.05)
    hidden = drawn(water, lid, lit=True).image
    alone = Render(camera(), studio_light())(lid).image
    inside = slice(40, 120)
    assert float((hidden - alone)[inside, inside].abs().mean()) < 0.02


def test_an_opaque_liquid_hides_what_is_behind_it_and_is_smooth() -> None:
    """Rough points of milk are no rough milk: its light is even, blended by splats it is not."""
    _, milk = pool(0.012)
    lift = torch.randn(milk.count, generator=torch.Generator().manual_seed(2))
    milk = milk.replace(means=milk.means + 1e-3 * lift[:, None] * milk.means.new_tensor([0, 0, 1]))
    under = [
        drawn(milk, stone(0.03), attenuation=math.inf).image,
        drawn(milk, stone(0.3), attenuation=math.inf).image,
    ]
    inside = slice(60, 100)
    assert float((under[0] - under[1])[inside, inside].abs().max()) < 2e-3
    even, rough = (
        drawn(milk, stone(0.03), lit=True, clear=clear, attenuation=math.inf).image[inside, inside]
        for clear in (True, False)
    )
    assert float(even.std(dim=(0, 1)).max()) < 0.3 * float(rough.std(dim=(0, 1)).max())


def test_edges_of_a_liquid_are_sharp_where_its_points_are_seen_apart() -> None:
    alpha = torch.tensor([[0.1, 0.25, 0.5, 0.75, 0.9, 0.97]])
    normal = torch.zeros(1, 6, 3)
    near = covered(Surface(alpha, torch.full_like(alpha, 2.0), normal), H, camera())
    assert near[0].tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0, 1.0])
    far = covered(Surface(alpha, torch.full_like(alpha, 20.0), normal), H, camera())
    torch.testing.assert_close(far, alpha)


def test_a_pixel_of_two_surfaces_catches_no_lamp() -> None:
    """Where a sheet ends before another one, and not on a slope, nor at an outline."""
    depth = torch.full((9, 9), 2.0)
    depth[:, 5:] = 2.0 + 30.0 * H
    alpha = torch.ones(9, 9)
    alpha[:, 8:] = 0.0
    found = single(Surface(alpha, depth, torch.zeros(9, 9, 3)), H)
    assert found[4].tolist()[:8] == [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0]
    slope = 2.0 + 2.0 * H * torch.arange(9.0).expand(9, 9)
    assert float(single(Surface(torch.ones(9, 9), slope, torch.zeros(9, 9, 3)), H).min()) == 1.0


def test_a_thin_spot_of_a_film_is_no_dark_pit() -> None:
    """What is seen through a gap between splats lies deeper, and would be in their shadow."""
    alpha, depth = torch.ones(80, 80), torch.full((80, 80), 2.0)
    alpha[40, 40], depth[40, 40] = 0.6, 2.0 + 1.5 * H
    normal = torch.tensor([0.0, 0.0, 1.0]).expand(80, 80, 3)
    made = smoothed(Surface(alpha, depth, normal), H, camera())
    assert float((made.depth - 2.0).abs().max()) < 0.1 * H


def test_a_normal_that_is_unsure_goes_with_those_around() -> None:
    """On an outline near and far side cancel; what was left of them was black."""
    normal = torch.tensor([0.0, 0.0, 1.0]).repeat(80, 80, 1)
    normal[40] = torch.tensor([0.1, 0.0, -0.02])
    made = smoothed(Surface(torch.ones(80, 80), torch.full((80, 80), 2.0), normal), H, camera())
    assert float(made.normal[..., 2].min()) > 0.99


def test_drops_face_the_eye() -> None:
    """The shortest axis of a ball is any: a drop was lit from wherever it pointed."""
    eye = torch.tensor([0.0, 0.0, 2.0])
    means, colors = torch.zeros(2, 3), torch.ones(2, 3)
    scales = torch.tensor([[1e-3, 1e-3, 1e-3], [4e-3, 1e-3, 4e-3]])
    axes = torch.tensor([[0.0, 1.0, 0.0]] * 2)
    found = surface_normals(Gaussians.from_colors(means, scales, colors, opacities=0.9), axes, eye)
    torch.testing.assert_close(found[0], torch.tensor([0.0, 0.0, 1.0]))
    assert found[1].abs().tolist() == [0.0, 1.0, 0.0]


def test_nothing_clear_leaves_the_picture_as_it_was() -> None:
    rest = stone(0.0)
    none = Clear(torch.zeros(rest.count, dtype=torch.bool), *(torch.zeros(0),) * 2, torch.ones(2))
    stage = Render(camera(), studio_light())
    assert torch.equal(stage(rest, clear=none).image, stage(rest).image)


def test_normals_are_smoothed_but_not_across_edges() -> None:
    generator = torch.Generator().manual_seed(1)
    normal = torch.tensor([0.0, 0.0, 1.0]).expand(80, 80, 3).clone()
    normal[:, 40:] = torch.tensor([1.0, 0.0, 0.0])
    depth = torch.full((80, 80), 2.0)
    depth[:, 40:] = 2.1
    rough = normal + 0.3 * torch.randn(80, 80, 3, generator=generator)
    made = smoothed(Surface(torch.ones(80, 80), depth, rough), H, camera()).normal
    off = (made * normal).sum(dim=2)
    before = (torch.nn.functional.normalize(rough, dim=2) * normal).sum(dim=2)
    assert float(off.min()) > 0.97 > 0.8 > float(before.min())
    empty = Surface(torch.zeros(80, 80), depth, rough)
    assert smoothed(empty, H, camera()) is empty


def test_schlick_and_what_stands_before() -> None:
    normal = torch.tensor([[[0.0, 0.0, 1.0]] * 3])
    rays = torch.nn.functional.normalize(
        torch.tensor([[[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, -1e-6]]]), dim=2
    )
    share, toward = mirrored(normal, rays)
    assert share[0].tolist() == pytest.approx(
        [0.02, 0.02 + 0.98 * (1 - 0.5**0.5) ** 5, 1.0], abs=1e-4
    )
    torch.testing.assert_close(toward[0, 1], torch.tensor([0.5**0.5, 0.0, 0.5**0.5]))
    surface = Surface(torch.ones(1, 3), torch.full((1, 3), 2.0), normal)
    depth = torch.tensor([[1.0, 2.0, 3.0]])
    assert in_front(surface, torch.ones(1, 3), depth, H)[0].tolist() == pytest.approx(
        [0.0, 0.5, 1.0]
    )


@pytest.mark.cuda
@pytest.mark.parametrize("attenuation", [LETS, math.inf])
def test_the_same_liquid_on_a_gpu(attenuation: float) -> None:
    _, water = pool(0.012)
    whole = Gaussians.cat([water, stone(0.03)])
    found = []
    for device in ("cpu", "cuda"):
        rows = (torch.arange(whole.count) < water.count).to(device)
        volume = torch.full((water.count,), H**3, device=device)
        lets, gloss = torch.full_like(volume, attenuation), volume.new_tensor([0.9, 200.0])
        told = Clear(rows, volume, lets, gloss)
        stage = Render(camera(), studio_light())
        made = stage(whole.to(device), clear=told)
        found.append((made.image.cpu(), made.alpha.cpu()))
    for one, other in zip(*found, strict=True):
        assert float((one - other).abs().mean()) < 1e-3
