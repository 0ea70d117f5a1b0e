"""Crack faces on a GPU: the same neighbours and the same faces as on the CPU."""

from __future__ import annotations

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import Carry, Points
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.scene.scene import Scene
from gsfluent.spatial.neighbours import nearest_rows

pytestmark = pytest.mark.cuda


def test_the_same_neighbours_are_found():
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(2))
    one = nearest_rows(points, points[:700], 12, 0.05)
    two = nearest_rows(points.cuda(), points[:700].cuda(), 12, 0.05)
    assert torch.equal(one[1], two[1].cpu())
    assert torch.allclose(one[0], two[0].cpu(), rtol=1e-12, atol=0.0)


def test_the_same_faces_open():
    found = []
    for device in ("cpu", "cuda"):
        scene = Scene(floor=None)
        scene.add(ellipsoid(splats=400), materials.glass)
        carry = Carry.bind(scene, build_matter(scene, 0.03, device=device))
        rest = carry.matter.rest
        right = rest[:, 0] > 0.0
        eye = torch.eye(3, device=device).expand(rest.shape[0], 3, 3).contiguous()
        away = torch.tensor([0.05, 0.0, 0.0], device=device) * right[:, None]
        points = Points(rest + away, eye, eye, right.to(torch.int32), torch.zeros_like(right))
        cracks = Repair("gap").begin(carry).step(points)
        assert cracks is not None and cracks.births is not None
        found.append((cracks.births, cracks.rest))
    (one, cut), (two, same) = found
    # the sites beside a face are those within a layer: at its very edge rounding decides
    ours, theirs = one.ids, two.ids.cpu()
    common = torch.isin(ours, theirs)
    assert float(common.float().mean()) > 0.995 and abs(len(ours) - len(theirs)) < 0.01 * len(ours)
    here, there = one.gaussians.means[common], two.gaussians.means.cpu()
    assert torch.allclose(here, there[torch.isin(theirs, ours)], atol=1e-5)
    assert torch.allclose(cut.means, same.means.cpu(), atol=1e-5)
