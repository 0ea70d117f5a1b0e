"""Masses by which a body has on the grid the moment of inertia that it has in space."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.problems.elastic import beams
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.shapes import ball, box, parameters
from gsfluent.ops.inertia import LEAST

SPACING = 0.5
BODIES = {
    "rod": box([0.1, 0.3, 0.2], [16.0, 4.0, 4.0], SPACING),
    "plate": box([0.1, 0.3, 0.2], [12.0, 12.0, 5.0], SPACING),
    "ball": ball([0.2, 0.1, 0.7], 5.0, SPACING),
}


def shares(points: Tensor) -> Tensor:
    return ops.inertial_shares(points, volume=torch.full_like(points[:, 0], SPACING**3), dx=1.0)


def on_the_grid(points: Tensor, mass: Tensor) -> float:
    """Trace of the second moment of the masses of the nodes about their centre, over the mass."""
    blocks = ops.build_blocks(points, dx=1.0)
    still = torch.zeros(len(points), 3, 3, dtype=points.dtype)
    grid, _ = ops.p2g(points, torch.zeros_like(points), still, mass, dx=1.0, blocks=blocks)
    weight, place = grid[0, ..., 3], blocks.node_positions(1.0, points.dtype)
    arm = place - (weight[..., None] * place).sum((0, 1)) / weight.sum()
    return float((weight * (arm * arm).sum(-1)).sum() / weight.sum())


@pytest.mark.parametrize("name", BODIES)
def test_the_moment_of_inertia_on_the_grid_is_that_of_the_body(name: str) -> None:
    points = BODIES[name]
    arm = points - points.mean(0)
    true = float((arm * arm).sum(1).mean()) + 0.25 * SPACING**2  # of boxes, not of points
    given = shares(points)
    assert float(given.mean()) == pytest.approx(1.0, abs=1e-12)
    assert float(given.min()) >= LEAST - 1.0 / 64.0
    assert on_the_grid(points, torch.ones_like(given)) - true == pytest.approx(0.6875, abs=1e-9)
    assert on_the_grid(points, given) == pytest.approx(true, abs=0.03)


def test_mass_goes_inwards_and_a_lone_point_keeps_its_own() -> None:
    points = BODIES["rod"]
    given = shares(points)
    across = (points[:, 1:] - points[:, 1:].mean(0)).abs().amax(1)
    inside = (points[:, 0] - points[:, 0].mean()).abs() < 4.0
    assert float(given[inside & (across > 1.5)].max()) < 1.0
    assert float(given[inside & (across < 1.0)].min()) > 1.0
    assert shares(points[:1]).tolist() == [1.0]
    assert shares(points[:0]).shape == (0,)


def test_a_rod_four_cells_thick_twists_as_fast_as_it_should() -> None:
    slow, exact, _ = beams.twist(4)
    found, _, _ = beams.twist(4, own=True)
    assert slow < 0.93 * exact
    assert found == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("poisson", [0.2, 0.45])
def test_light_points_need_no_shorter_steps(poisson: float) -> None:
    young = (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson)
    points = box([0.1, 0.2, 0.3], [3.0, 3.0, 3.0], SPACING)
    draw = torch.Generator().manual_seed(0)
    points = points + 0.25 * (torch.rand(points.shape, generator=draw, dtype=torch.float64) - 0.5)
    mass = SPACING**3 * shares(points)
    assert float(mass.min()) < 0.45 * SPACING**3
    noise = 0.05 * torch.randn(points.shape, generator=draw, dtype=torch.float64)
    world = World(
        points, noise, volume=SPACING**3, mass=mass, dx=1.0, law=0, cfl=0.5,
        params=parameters(young, poisson, 1.0),
    )  # fmt: skip
    before = world.kinetic()
    world.run(50.0)
    assert world.kinetic() + world.elastic() < 0.02 * before


def test_what_is_refused() -> None:
    points = BODIES["ball"]
    volume = torch.ones_like(points[:, 0])
    with pytest.raises(ValueError, match="dx must be positive"):
        ops.inertial_shares(points, volume=volume, dx=0.0)
    with pytest.raises(ValueError, match="volume must be positive"):
        ops.inertial_shares(points, volume=volume - 1.0, dx=1.0)
    with pytest.raises(ValueError, match="must be finite"):
        ops.inertial_shares(points * float("nan"), volume=volume, dx=1.0)


@pytest.mark.cuda
def test_the_gpu_shares_out_as_the_cpu_does() -> None:
    points = BODIES["plate"]
    volume = torch.full_like(points[:, 0], SPACING**3)
    there = ops.inertial_shares(points.cuda(), volume=volume.cuda(), dx=1.0)
    assert float((there.cpu() - shares(points)).abs().max()) <= 1.0 / 64.0  # of a rounding
