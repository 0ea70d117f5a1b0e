"""Blades and such are set into the picture of what they touch pixel by pixel."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.light.lamps import studio_light
from gsfluent.pipeline.render.merge import merged
from gsfluent.pipeline.render.stage import Render

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def layer(depth: list[float], alpha: float, color: tuple[float, float, float]) -> Rendered:
    z = torch.tensor([depth])
    cover = torch.full_like(z, alpha) * (z > 0.0)
    image = cover[..., None] * torch.tensor(color)
    return Rendered(image, cover, z, image.clone(), None, torch.zeros(0, dtype=torch.int32))


def test_what_is_nearer_covers_what_is_behind() -> None:
    """Opaque, clear, and beside each other; either order of the two gives the same picture."""
    one, other = layer([1.0, 2.0, 1.0, 0.0], 1.0, RED), layer([2.0, 1.0, 0.0, 0.0], 1.0, BLUE)
    for pair in ((one, other), (other, one)):
        made = merged(*pair, torch.tensor(100.0))
        wanted = torch.tensor([[RED, BLUE, RED, (0.0, 0.0, 0.0)]])
        torch.testing.assert_close(made.image, wanted)
        torch.testing.assert_close(made.normal, wanted)
        torch.testing.assert_close(made.depth, torch.tensor([[1.0, 1.0, 1.0, 0.0]]))
        assert made.alpha.tolist() == [[1.0, 1.0, 1.0, 0.0]]
    made = merged(layer([1.0], 0.5, RED), layer([2.0], 0.5, BLUE), torch.tensor(100.0))
    blend = 0.5 * torch.tensor(RED) + 0.25 * torch.tensor(BLUE)
    torch.testing.assert_close(made.image[0, 0], blend)
    assert float(made.alpha) == pytest.approx(0.75)
    assert float(made.depth) == pytest.approx(4.0 / 3.0)  # type: ignore[arg-type]
    same = merged(layer([1.0], 1.0, RED), layer([1.0], 1.0, BLUE), torch.tensor(100.0))
    torch.testing.assert_close(same.image[0, 0], 0.5 * (torch.tensor(RED) + torch.tensor(BLUE)))


def scene() -> tuple[Gaussians, Tensor]:
    """A slab of wide blue splats, z = 0, and a red plate that stands in it, x = 0.4 z."""
    line = torch.arange(-0.1, 0.1001, 0.02)
    x, y = (part.flatten() for part in torch.meshgrid(line, line, indexing="ij"))
    slab = torch.stack([x, y, torch.zeros_like(x)], 1)
    fine = torch.arange(-0.06, 0.0601, 0.003)
    z, y = (part.flatten() for part in torch.meshgrid(fine, fine, indexing="ij"))
    plate = torch.stack([0.4 * z, y, z], 1)
    wide, small = torch.full((len(slab), 3), 0.02), torch.full((len(plate), 3), 0.0025)
    wide[:, 2] = 0.004
    both = [
        Gaussians.from_colors(slab, wide, torch.tensor([BLUE]).expand_as(slab), opacities=0.97),
        Gaussians.from_colors(plate, small, torch.tensor([RED]).expand_as(plate), opacities=0.97),
    ]
    whole = Gaussians.cat(both)
    return whole, torch.arange(whole.count) >= len(slab)


def test_a_blade_is_not_painted_over_by_splats_that_reach_through_it() -> None:
    """Seen from above and aside: all of the plate above the slab is red, nothing of it below is."""
    whole, rigid = scene()
    camera = Camera.look_at((0.25, 0.0, 0.35), (0.0, 0.0, 0.0), width=120, height=120, fov=25.0)
    plate = whole.means[rigid]
    plate = plate[plate[:, 1].abs() < 0.04]
    above, below = (
        plate[(side * plate[:, 2] > 0.006) & (side * plate[:, 2] < 0.03)] for side in (1.0, -1.0)
    )
    worst = []
    for rows in (None, rigid):
        image = Render(camera)(whole, rigid=rows).image
        redness = []
        for places in (above, below):
            view = camera.viewmat.float()
            seen = places @ view[:3, :3].T + view[:3, 3]
            x, y, z = (seen @ camera.K.float().T).unbind(dim=1)
            pixel = image[(y / z).long(), (x / z).long()]
            redness.append(pixel[:, 0] - pixel[:, 2])
        worst.append((float(redness[0].min()), float(redness[1].max())))
    assert worst[1][0] > 0.7 and worst[1][1] < -0.7
    assert worst[0][0] < 0.5 or worst[0][1] > -0.5


def test_light_falls_on_both_and_nothing_rigid_changes_nothing() -> None:
    whole, rigid = scene()
    camera = Camera.look_at((0.25, 0.0, 0.35), (0.0, 0.0, 0.0), width=60, height=60, fov=25.0)
    stage = Render(camera, studio_light())
    plain = stage(whole).image
    assert torch.equal(stage(whole, rigid=torch.zeros_like(rigid)).image, plain)
    torch.testing.assert_close(stage(whole, rigid=torch.ones_like(rigid)).image, plain)
    lit = stage(whole, rigid=rigid).image
    assert torch.isfinite(lit).all() and float((lit - plain).abs().mean()) < 0.05


@pytest.mark.cuda
def test_the_same_on_a_gpu() -> None:
    whole, rigid = scene()
    camera = Camera.look_at((0.25, 0.0, 0.35), (0.0, 0.0, 0.0), width=120, height=120, fov=25.0)
    stage = Render(camera, studio_light())
    found = [
        stage(whole.to(device), rigid=rigid.to(device)).image.cpu() for device in ("cpu", "cuda")
    ]
    assert float((found[0] - found[1]).abs().mean()) < 1e-3
