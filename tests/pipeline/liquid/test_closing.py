"""Gaps between the points of a liquid are closed in its picture, and its rims are smooth; drops,
strands and what is apart in depth stay as they are. Its light is asked for once."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.light.lamps import studio_light
from gsfluent.pipeline.liquid.clear import Clear, Surface
from gsfluent.pipeline.liquid.closing import closed
from gsfluent.pipeline.liquid.sheet import ellipsoids
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio

H = 0.004
SIZE = 160
PIXELS = 0.5 * SIZE / math.tan(math.radians(2.0)) * H / 2.0
"""A spacing of the points [px]."""
ROW, COLUMN = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")


def camera() -> Camera:
    """Looks down on the origin from 2 m."""
    return Camera.look_at((0.0, -1e-3, 2.0), (0.0, 0.0, 0.0), width=SIZE, height=SIZE, fov=4.0)


def disc(x: float, y: float, radius: float | Tensor) -> Tensor:
    """Opacity of a disc with an edge of a pixel, [H, W]."""
    far = ((COLUMN - x) ** 2 + (ROW - y) ** 2).sqrt()
    return (radius - far + 0.5).clamp(0.0, 1.0)


def seen(alpha: Tensor, depth: Tensor | None = None) -> Tensor:
    """Opacity of a liquid whose splats have this one."""
    depth = torch.full_like(alpha, 2.0) if depth is None else depth
    normal = torch.tensor([0.0, 0.0, 1.0]) * alpha[..., None]
    paint = alpha[..., None] * torch.tensor([0.8, 0.7, 0.6])
    made, unit = closed(Surface(0.97 * alpha, depth, normal), 0.97 * paint, H, camera())
    wet = made.alpha > 0.01
    assert torch.allclose(unit[wet], torch.tensor([0.8, 0.7, 0.6]), atol=2e-3)
    assert torch.allclose(made.depth[wet & (depth == 2.0)], torch.tensor(2.0), atol=1e-4) or (
        depth.unique().numel() > 1
    )
    return made.alpha


def test_a_pinhole_is_closed_and_a_hole_is_not() -> None:
    whole = disc(80, 80, 60)
    assert float(seen(whole - disc(80, 80, PIXELS))[60:100, 60:100].min()) > 0.999
    open_ = seen(whole - disc(80, 80, 4.0 * PIXELS))
    assert float(open_[80, 80]) < 0.01
    # its edge is hardly nearer: sigma^2 / 2 R
    across = open_[80, 80:120]
    assert float((1.0 - across).sum()) == pytest.approx(4.0 * PIXELS, abs=0.3 * PIXELS)


def test_a_rim_of_scallops_is_smooth() -> None:
    angle = torch.atan2(ROW - 80, COLUMN - 80)
    rough = disc(80, 80, 60 + 0.7 * PIXELS * torch.cos(24 * angle))

    def ripple(alpha: Tensor) -> float:
        return float((alpha * torch.cos(24 * angle)).sum())

    assert ripple(seen(rough)) < 0.2 * ripple(rough)


def test_straight_edges_drops_and_strands_stay() -> None:
    half = (COLUMN < 80).float()
    edge = seen(half)[80]
    assert float(edge.sum()) == pytest.approx(80.0, abs=0.5)
    drop = disc(130, 80, 0.6 * PIXELS)
    beside = seen((half + drop).clamp(max=1.0))
    assert float(beside[:, 110:].sum()) == pytest.approx(float(seen(drop)[:, 110:].sum()), rel=0.05)
    assert float(seen(drop).max()) > 0.95
    strand = ((ROW - 80).abs() < 0.6 * PIXELS).float()
    assert float(seen(strand)[80].min()) > 0.95


def test_a_drop_joins_a_rim_without_a_pop() -> None:
    """From three spacings off to inside, a tenth of a spacing a step: no step is a fifth of it."""
    half = (COLUMN < 80).float()
    shown = []
    for step in range(41):
        drop = disc(80 + (3.0 - 0.1 * step) * PIXELS, 80, 0.6 * PIXELS)
        shown.append(float(seen(torch.maximum(half, drop)).sum()))
    area = float(drop.sum())
    assert abs(shown[0] - shown[-1]) < 1.5 * area
    assert max(abs(a - b) for a, b in itertools.pairwise(shown)) < 0.2 * area


def test_a_gap_between_two_sheets_stays() -> None:
    """A curtain before a pool: what is between them is seen."""
    gap = 0.7 * PIXELS
    alpha = ((COLUMN - 80).abs() > gap).float()
    flat = seen(alpha)
    apart = seen(alpha, torch.where(COLUMN < 80, 1.9, 2.1))
    assert float(flat[80].min()) > 0.99
    assert float(apart[80, 80]) < 0.1


def test_an_outline_faces_as_what_is_beside_it() -> None:
    """Splats of the near and the far side cancelled each other there: specks in the dark."""
    alpha, depth = (COLUMN < 80).float(), torch.full((SIZE, SIZE), 2.0)
    normal = torch.tensor([0.0, -0.6, 0.8]).repeat(SIZE, SIZE, 1) * alpha[..., None]
    normal[70:90:3, 79] = torch.tensor([0.1, 0.05, -0.1])
    depth[70:90:3, 79] += 5.0 * H
    made, _ = closed(Surface(0.97 * alpha, depth, normal), alpha[..., None], H, camera())
    face = torch.nn.functional.normalize(made.normal[70:90, 79], dim=1)
    assert float((face @ torch.tensor([0.0, -0.6, 0.8])).min()) > 0.99


def test_nothing_to_be_seen_stays_nothing() -> None:
    empty = Surface(torch.zeros(8, 8), torch.zeros(8, 8), torch.zeros(8, 8, 3))
    made, paint = closed(empty, torch.zeros(8, 8, 4), H, camera())
    assert made is empty
    assert not bool(paint.any())


def plate(side: float, z: float, color: tuple[float, float, float], step: float) -> Gaussians:
    line = torch.arange(-side, side + 1e-9, step)
    x, y = torch.meshgrid(line, line, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3)
    paint = means.new_tensor(color).expand_as(means).contiguous()
    return Gaussians.from_colors(
        means, torch.full((len(means),), 0.6 * step), paint, opacities=0.95
    )


def poured(gap: float, wide: float = 0.04) -> tuple[Gaussians, Clear]:
    """A film of milk that lacks the points within ``gap`` of its middle, over a red plate."""
    milk = plate(wide, 0.0, (0.9, 0.9, 0.85), H)
    milk = milk.select((milk.means.norm(dim=1) >= gap).nonzero()[:, 0])
    whole = Gaussians.cat([milk, plate(0.08, -0.03, (0.8, 0.1, 0.1), 0.002)])
    volume = torch.full((milk.count,), H**3)
    rows = torch.arange(whole.count) < milk.count
    return whole, Clear(rows, volume, torch.full_like(volume, math.inf), torch.tensor([0.5, 60.0]))


def test_no_red_shows_through_a_film_of_milk_that_lacks_a_point() -> None:
    torn, clear = poured(0.9 * H)
    made = Render(camera(), studio_light())(torn, clear=clear)
    whole = Render(camera(), studio_light())(*poured(0.0)[:1], clear=poured(0.0)[1])
    middle = slice(70, 90)
    assert float((made.image - whole.image)[middle, middle].abs().max()) < 0.03
    assert float(made.alpha[middle, middle].min()) > 0.999
    far, clear = poured(6.0 * H)
    assert float(Render(camera(), studio_light())(far, clear=clear).image[80, 80, 1]) < 0.3


def test_what_milk_hides_is_not_lit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light is what a picture of milk costs: hardly a pixel may be asked for twice."""
    lit = 0

    def counted(image: Tensor, alpha: Tensor, *rest: Tensor, **options: object) -> Tensor:
        nonlocal lit
        lit += int((alpha > 1e-4).sum())
        return shade(image, alpha, *rest, **options)  # type: ignore[arg-type]

    shade = ops.shade
    monkeypatch.setattr(ops, "shade", counted)
    whole, clear = poured(0.0)
    stage = Render(camera(), studio_light())
    stage(whole, clear=clear)
    wet, lit = lit, 0
    stage(whole)
    assert wet < 1.25 * lit


@pytest.mark.parametrize("attenuation", [30.0, math.inf])
def test_matter_that_is_all_liquid_is_drawn_as_one(attenuation: float) -> None:
    """The same with a speck of something solid that is out of the picture."""
    whole, clear = poured(0.9 * H)
    milk = whole.select(clear.rows.nonzero()[:, 0])
    speck = Gaussians.from_colors(
        torch.tensor([[0.0, 0.0, -5.0]]), torch.ones(1) * 1e-3, torch.ones(1, 3), opacities=1e-3
    )
    lets = torch.full_like(clear.volume, attenuation)
    alone, beside = torch.ones(milk.count, dtype=torch.bool), torch.ones(milk.count + 1).bool()
    beside[-1] = False
    stage = Render(camera())
    found = stage(milk, clear=clear._replace(rows=alone, attenuation=lets))
    wanted = stage(
        Gaussians.cat([milk, speck]), clear=clear._replace(rows=beside, attenuation=lets)
    )
    torch.testing.assert_close(found.image, wanted.image, atol=2e-3, rtol=0.0)
    assert float(found.alpha[70:90, 70:90].min()) > 0.999
    lit = Render(camera(), studio_light())(milk, clear=clear._replace(rows=alone, attenuation=lets))
    assert float(lit.image[70:90, 70:90].std(dim=(0, 1)).max()) < 0.02
    assert bool(lit.image.isfinite().all())


def test_water_alone_hides_no_surroundings() -> None:
    """As it hides none where something solid is in the scene, too."""
    whole, clear = poured(0.0)
    water = whole.select(clear.rows.nonzero()[:, 0])
    lets = torch.full_like(clear.volume, 30.0)
    every = clear._replace(rows=torch.ones(water.count, dtype=torch.bool), attenuation=lets)
    stage = Render(camera(), studio_light(), studio=Studio(-0.004, (0.0, 0.0), 0.04, 0.2))
    dim = Render(
        camera(),
        dataclasses.replace(studio_light(), occlusion=0.0),
        studio=Studio(-0.004, (0.0, 0.0), 0.04, 0.2),
    )
    assert torch.equal(stage(water, clear=every).image, dim(water, clear=every).image)
    milk = every._replace(attenuation=torch.full_like(lets, math.inf))
    assert not torch.equal(stage(water, clear=milk).image, dim(water, clear=milk).image)


def test_a_film_of_fine_points_has_the_rim_of_a_liquid() -> None:
    """Points half a millimetre apart thin out at the rim of a pool: it is as smooth as that of
    points three times as coarse, and no fringe of dots; its face mirrors without ripples."""
    fine, generator = 5e-4, torch.Generator().manual_seed(3)
    line = torch.arange(-0.03, 0.03, fine)
    x, y = torch.meshgrid(line, line, indexing="ij")
    means = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    means = means + 0.3 * fine * (torch.rand(means.shape, generator=generator) - 0.5)
    far = means.norm(dim=1)
    kept = torch.rand(len(far), generator=generator) < ((0.027 - far) / 0.006).clamp(0.0, 1.0)
    means = means[kept]
    volume = torch.full((len(means),), fine**3)
    drawn = ellipsoids(means, volume)
    paint = torch.full_like(means, 0.9)
    milk = Gaussians.from_colors(drawn.means, drawn.scales, paint, opacities=0.95)
    milk = milk.replace(quats=drawn.quats)
    rows = torch.ones(len(means), dtype=torch.bool)
    clear = Clear(rows, volume, torch.full_like(volume, math.inf), torch.tensor([0.5, 60.0]))
    near = Camera.look_at((0.0, -1e-3, 0.4), (0.0, 0.0, 0.0), width=240, height=240, fov=10.0)
    made = Render(near, studio_light())(milk, clear=clear)
    rows, columns = (made.alpha > 0.5).nonzero().double().sub(119.5).unbind(dim=1)
    sector = ((torch.atan2(rows, columns) / math.pi + 1.0) * 36.0).long().clamp(max=71)
    rim = torch.zeros(72, dtype=torch.float64)
    rim.scatter_reduce_(0, sector, rows.hypot(columns), "amax")
    assert float(rim.min()) > 80.0 and float(rim.std()) < 1.2
    assert float(made.image[100:140, 100:140].std(dim=(0, 1)).max()) < 0.01


def test_a_drop_that_has_faded_is_not_drawn() -> None:
    place = torch.tensor([[0.0, 0.0, 0.0]])
    drop = Gaussians.from_colors(place, torch.tensor([0.3 * H]), torch.ones(1, 3), opacities=0.95)
    clear = Clear(
        torch.ones(1, dtype=torch.bool), torch.tensor([H**3]), torch.tensor([math.inf]),
        torch.tensor([0.5, 60.0]),
    )  # fmt: skip
    found = []
    for opacity in (0.95, 0.4, 0.15, 0.0):
        shown = drop.replace(opacities=torch.full_like(drop.opacities, opacity))
        found.append(float(Render(camera(), studio_light())(shown, clear=clear).alpha.max()))
    assert found[0] > 0.9 and found[1] == found[0]
    assert found[2] < 0.7 * found[0] and found[3] == 0.0
