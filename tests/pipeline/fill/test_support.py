"""A thing photographed from above ends in the plane that it stood on, not in a cone."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent.data import Camera, Capture, Gaussians, View
from gsfluent.pipeline.capture.orient import make_frame
from gsfluent.pipeline.fill.stage import Fill

RADIUS, HEIGHT = 0.5, 0.8


def vessel(cone: float) -> Gaussians:
    """Splats on an upright cylinder on z = 0, with a cone of some depth where its base is."""
    spread = torch.Generator().manual_seed(0)
    turn = 2.0 * math.pi * torch.rand(9000, generator=spread)
    side, lid, under = turn.split(3000)
    z = HEIGHT * torch.rand(3000, generator=spread)
    far = torch.rand(3000, generator=spread).sqrt()
    points = [
        torch.stack([RADIUS * side.cos(), RADIUS * side.sin(), z], 1),
        torch.stack(
            [RADIUS * far * lid.cos(), RADIUS * far * lid.sin(), torch.full_like(far, HEIGHT)], 1
        ),
        torch.stack(
            [RADIUS * far * under.cos(), RADIUS * far * under.sin(), cone * (far - 1.0)], 1
        ),
    ]
    means = torch.cat(points)
    return Gaussians.from_colors(
        means, torch.full((len(means), 3), 0.02), torch.full((len(means), 3), 0.5), opacities=0.95
    )


def from_above() -> Capture:
    """Cameras on a ring above a table whose sparse points lie on z = 0."""
    cameras = []
    for turn in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False):
        eye = torch.tensor([2.5 * math.cos(turn), 2.5 * math.sin(turn), 2.5], dtype=torch.float64)
        target = torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64)
        cameras.append(Camera.look_at(eye, target, width=64, height=64, fov=40.0))
    table = 3.0 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(1)).double() - 1.5
    table[:, 2] = 0.0
    table = table[table[:, :2].norm(dim=1) > RADIUS]
    thing = vessel(0.0).means.double()[:6000:6]
    points = torch.cat([table, thing])
    return Capture(cameras, points, torch.zeros(len(points), 3), Path(), reader=grey)


def grey(camera: Camera, _: int | None) -> View:
    """A photograph without a mask."""
    return View(torch.full((camera.height, camera.width, 3), 0.5), None, None, camera)


def areas(solid: object) -> tuple[float, float, float]:
    """Lowest matter, and the sections just above it and in the middle of the height."""
    occupied, voxel = solid.occupancy, solid.voxel  # type: ignore[attr-defined]
    section = occupied.sum(dim=(0, 1)).double() * voxel**2
    layers = section.nonzero()[:, 0]
    low = float(solid.origin[2]) + int(layers[0]) * voxel  # type: ignore[attr-defined]
    return low, float(section[int(layers[0]) + 1]), float(section[int(layers.double().mean())])


@pytest.mark.parametrize("cone", [0.15, 0.35])
def test_the_cone_below_the_support_goes(cone: float) -> None:
    fill = Fill(resolution=40, down=(0.0, 0.0, -1.0), refine_views=0, method="vote")
    splats, capture = vessel(cone), from_above()
    low, tip, _ = areas(fill(splats))
    assert low < -0.6 * cone and tip < 0.3 * math.pi * RADIUS**2  # what it stood on without
    solid = fill(splats, capture)
    low, base, middle = areas(solid)
    assert abs(low) < 1.5 * solid.voxel
    assert base == pytest.approx(middle, rel=0.12)
    assert float(solid.gaussians.means[:, 2].min()) > -2.0 * solid.voxel
    # and the frame puts that plane on the floor, at the size of the thing without its cone
    frame = make_frame(splats, capture)
    assert float(frame.apply(torch.zeros(1, 3, dtype=torch.float64))[0, 2]) == pytest.approx(
        0.0, abs=0.03 * frame.scale
    )


def test_a_plane_through_the_middle_is_no_support() -> None:
    splats, capture = vessel(0.0), from_above()
    raised = splats.replace(means=splats.means - torch.tensor([0.0, 0.0, 0.5 * HEIGHT]))
    solid = Fill(resolution=40, refine_views=0, method="vote")(raised, capture)
    assert solid.volume == pytest.approx(math.pi * RADIUS**2 * HEIGHT, rel=0.15)
