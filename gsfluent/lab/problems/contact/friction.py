"""Bodies on a surface: a block that slides, stops or rests, a ball that rolls.

Units as in :mod:`gsfluent.lab.problems.contact.contact`. The surface is a body of its own, held by
a sticky plane at
its bottom; an incline is gravity at an angle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfluent.lab.problems.contact.contact import SPACING, bodies, smooth_ball, turning
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box
from gsfluent.lab.world.walls import wall

PULL = 0.0025
"""Gravity [cells / s^2]: strains of a percent, a tenth of the wave speed after a few cells."""


def _on_slab(
    top: Tensor, length: float, width: float, angle: float, friction: float, speed: float = 0.0,
    pull: float = PULL, **options: Any,
) -> tuple[World, Tensor]:  # fmt: skip
    """A body on a slab whose surface is z = 0, gravity at ``angle`` to it; the body's mask."""
    slab = box((-2.0, -0.5 * width, -3.0), (length, width, 3.0), SPACING)
    slope = math.radians(angle)
    along = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    world = bodies(
        [top, slab], [along, torch.zeros(3, dtype=torch.float64)], friction=friction,
        gravity=(pull * math.sin(slope), 0.0, -pull * math.cos(slope)),
        colliders=[wall(2, -2.0, mode="sticky")], **options,
    )  # fmt: skip
    return world, torch.arange(len(world.position)) < len(top)


def _speed(world: World, of: Tensor) -> float:
    return float(world.momentum(of)[0] / world.scene.mass[of].double().sum())


BLOCK = (8.0, 6.0, 3.0)


def _block() -> Tensor:
    return box((0.0, -3.0, 0.0), BLOCK, SPACING)


def slide(friction: float, angle: float = 45.0, dtype: torch.dtype = torch.float64) -> Result:
    """Coefficient of friction seen in the acceleration of a sliding block."""
    world, block = _on_slab(_block(), 22.0, 10.0, angle, friction, dtype=dtype)
    # Friction starts from nothing and a shear wave runs through the block: measured after that.
    world.run(40.0)
    first = _speed(world, block)
    world.run(60.0)
    slope = math.radians(angle)
    gained = (_speed(world, block) - first) / 60.0 / PULL
    seen = (math.sin(slope) - gained) / math.cos(slope)
    note = f"{angle:g} degrees, {str(dtype).removeprefix('torch.')}"
    if friction == 0.0:
        return compare(
            "acceleration / (g sin)", gained / math.sin(slope), 1.0, tolerance=0.03,
            source="no friction", note=note, name="block_on_incline",
        )  # fmt: skip
    return compare(
        "friction seen", seen, friction, tolerance=0.03, source="Coulomb", note=note,
        name="block_on_incline",
    )  # fmt: skip


@problem(tier="fast")
def block_on_incline() -> Result:
    """A block slides down 45 degrees as Coulomb's law says."""
    return slide(0.5)


@problem(tier="slow")
def block_on_inclines() -> Iterator[Result]:
    """A block slides down inclines of several angles and frictions as Coulomb's law says."""
    for friction, angle in ((0.0, 45.0), (0.25, 45.0), (0.5, 45.0), (0.75, 45.0), (0.2, 20.0)):
        yield slide(friction, angle)
    yield slide(0.5, dtype=torch.float32)


@problem(tier="fast")
def block_stops() -> Result:
    """A block thrown along a level surface stops after v^2 / (2 mu g)."""
    speed = 0.06
    friction = 0.5
    world, block = _on_slab(_block(), 16.0, 10.0, 0.0, friction, speed)
    start = float(world.center(block)[0])
    want = speed**2 / (2.0 * friction * PULL)
    world.run(1.5 * speed / (friction * PULL))
    return compare(
        "distance", float(world.center(block)[0]) - start, want, tolerance=0.05, unit="dx",
        source="Coulomb", note=f"left of its speed {_speed(world, block) / speed:.4f}",
    )  # fmt: skip


@problem(tier="fast")
def block_rests() -> list[Result]:
    """A block on 45 degrees whose friction exceeds 1 stays where it is."""
    world, block = _on_slab(_block(), 16.0, 10.0, 45.0, 1.5)
    world.run(60.0)
    window: list[Tensor] = []
    world.run(120.0, each=lambda now: window.append(now.center(block)))
    half = len(window) // 2  # mean place over two windows: the elastic swing averages out
    places = [torch.stack(part).mean(0) for part in (window[:half], window[half:])]
    moved = (places[1] - places[0]) / 60.0
    free = PULL * math.sin(math.radians(45.0)) * 60.0  # what gravity gives in that time
    return [
        compare(
            "creep / speed of free slip", float(moved[0]) / free, tolerance=0.03, source="Coulomb",
        ),
        compare(
            "sinking", -float(moved[2]), tolerance=0.1 * PULL * 60.0, unit="dx/s",
            source="equations.md 11.4",
        ),
    ]  # fmt: skip


@problem(tier="slow")
def ball_rolls() -> list[Result]:
    """A ball rolls down an incline with 5/7 g sin(angle) and does not slip."""
    radius = 6.0
    points, volume = smooth_ball(radius)
    points = points + torch.tensor([radius, 0.0, radius], dtype=torch.float64)
    slab = torch.full((round(24 / SPACING) * round(12 / SPACING) * round(3 / SPACING),), SPACING**3)
    volume = torch.cat([volume, slab.double()])
    slope, calm = math.radians(20.0), 150.0
    level = PULL * torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    tilted = PULL * torch.tensor([math.sin(slope), 0.0, -math.cos(slope)], dtype=torch.float64)

    def gravity(now: World, dt: float) -> None:
        # Lower the ball gently, then tilt: a ball that hops is in contact half of the time.
        if now.time < calm:
            now.velocity = now.velocity * (1.0 - 0.05 * dt) + dt * level.to(now.velocity)
        else:
            now.velocity = now.velocity + dt * tilted.to(now.velocity)

    world, ball = _on_slab(points, 24.0, 12.0, 0.0, 0.5, pull=0.0, force=gravity, volume=volume)
    world.run(calm + 40.0)
    first = _speed(world, ball)
    world.run(60.0)
    last = _speed(world, ball)
    want = 5.0 / 7.0 * PULL * math.sin(slope)
    spin = float(turning(world, ball)[1])
    return [
        compare(
            "acceleration / (5/7 g sin)", (last - first) / 60.0 / want, 1.0, tolerance=0.08,
            source="rigid ball", note="both ball and ground are soft",
        ),
        compare("omega R / v", spin * radius / last, 1.0, tolerance=0.05, source="no slip"),
    ]  # fmt: skip
