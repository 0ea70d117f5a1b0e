"""Failure catalogue (solver.md section 4), rows of contact: 11, 12, 13, 14, 23."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.shapes import ball, box, parameters, wave_speed
from gsfluent.lab.world.walls import wall

DX = 0.1
POINT = (0.5 * DX) ** 3
ROW = parameters(1e5, 0.3, 1000.0)
C = wave_speed(ROW)


def pair(one: Tensor, other: Tensor, velocity: Tensor, *, fields: int) -> tuple[World, Tensor]:
    """Two bodies, in a velocity field each or (as in codes without contact) in one."""
    body = torch.cat([torch.zeros(len(one)), torch.ones(len(other))]).int()
    world = World(
        torch.cat([one, other]), velocity[body.long()], mass=1000.0 * POINT, volume=POINT, dx=DX,
        law=0, params=ROW, body=body if fields == 2 else None,
    )  # fmt: skip
    return world, body == 1


def along_x(speed: float) -> Tensor:
    return torch.tensor([[-speed, 0.0, 0.0], [speed, 0.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("share", [0.01, 0.001])
def test_row_11_blocks_that_touch_part_freely(share: float) -> None:
    """Leaving at a hundredth or a thousandth of the wave speed; one field holds them back."""
    one = box([0.0, 0.0, 0.0], [0.4, 0.3, 0.3], 0.5 * DX)
    other = one + torch.tensor([0.4, 0.0, 0.0])
    kept = {}
    for fields in (2, 1):
        world, second = pair(one, other, along_x(share * C), fields=fields)
        world.run(seconds=12.0 * 0.8 / C)
        kept[fields] = float(world.velocity[second, 0].mean()) / (share * C)
    assert abs(kept[2] - 1.0) < 1e-3
    assert kept[1] < 0.8  # glued, and turned around later


def test_row_12_bodies_meet_when_they_touch_and_not_two_cells_earlier() -> None:
    gap, onset = 2.5 * DX, {}
    for fields in (2, 1):
        one = box([0.0, 0.0, 0.0], [0.3, 0.3, 0.3], 0.5 * DX)
        other = one + torch.tensor([0.3 + gap, 0.0, 0.0])
        world, second = pair(one, other, along_x(-0.02 * C), fields=fields)
        found: list[float] = []

        def watch(w: World, second: Tensor = second, found: list[float] = found) -> None:
            if not found and abs(float(w.velocity[second, 0].mean())) < 0.999 * 0.02 * C:
                x = w.position[:, 0]
                found.append((float(x[second].min() - x[~second].max()) - 0.5 * DX) / DX)

        world.run(seconds=0.8 * gap / (0.02 * C), each=watch)
        onset[fields] = found[0] if found else math.nan
    assert -0.5 < onset[2] < 0.5 and onset[1] > 1.5


def test_row_13_frictionless_oblique_spheres_do_not_spin() -> None:
    radius, speed, spin = 0.25, 0.05 * C, {}
    one = ball([0.0, 0.0, 0.0], radius, 0.5 * DX)
    side = 2.0 * radius * math.sqrt(0.5)
    other = ball([side + 0.03, side, 0.0], radius, 0.5 * DX)
    for fields in (2, 1):
        world, second = pair(one, other, along_x(-speed), fields=fields)
        world.run(seconds=0.3 * radius / speed + 4.0 * radius / C)
        inertia = 0.4 * 1000.0 * POINT * len(other) * radius**2
        turn = float(world.angular_momentum(world.center(second), second)[2]) / inertia
        spin[fields] = abs(turn * radius / speed)
        assert abs(float(world.velocity[second, 0].mean()) / speed) < 0.6  # they did meet
    assert spin[2] < 0.02 and spin[1] > 0.2  # the bar of solver.md 3 row 10, at a radius of 2.5 dx


@pytest.mark.parametrize("share", [0.01, 0.1, 0.3])
def test_row_14_a_ball_does_not_sink_into_the_floor_and_bounces(share: float) -> None:
    floor = wall(2, mode="separate")[None]
    world = World(
        ball([0.0, 0.0, 0.3], 0.25, 0.5 * DX), [0.0, 0.0, -share * C], mass=1000.0 * POINT,
        volume=POINT, dx=DX, law=0, params=ROW, colliders=floor, dtype=torch.float32,
    )  # fmt: skip
    lowest = [1.0]
    world.run(
        seconds=0.05 / (share * C) + 3.0 / C * (1.0 + 0.3 / share**0.2),
        each=lambda w: lowest.append(float(w.position[:, 2].min()) / DX),
    )
    assert min(lowest) > 0.0  # no point ever goes below the plane
    assert 0.75 < float(world.velocity[:, 2].double().mean()) / (share * C) < 1.0


@pytest.mark.parametrize("mach", [2.0, 6.0])
def test_row_23_a_fast_bullet_does_not_pass_unseen(mach: float) -> None:
    """Radius one cell, up to six times the wave speed of plate and bullet, plate two cells."""
    plate = box([0.0, 0.0, 0.0], [0.2, 0.8, 0.8], 0.5 * DX)
    bullet = ball([-0.35, 0.4, 0.4], DX, 0.5 * DX)
    speed = mach * C
    world, second = pair(
        plate, bullet, torch.tensor([[0.0, 0.0, 0.0], [speed, 0.0, 0.0]]).double(), fields=2
    )
    before = world.momentum()
    furthest: list[float] = []
    world.run(
        seconds=0.8 / speed,
        each=lambda w: furthest.append(w.dt * float(w.velocity.norm(dim=1).max()) / DX),
    )
    assert max(furthest) < 0.6  # the step knows the speed: half a cell
    assert float(world.velocity[second, 0].mean()) < 0.6 * speed
    assert torch.allclose(world.momentum(), before, rtol=1e-10, atol=1e-10 * float(before[0]))
