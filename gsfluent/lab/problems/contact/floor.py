"""Bodies on a rigid floor that pushes points: where they rest, what a bounce keeps, friction.

Units as in :mod:`gsfluent.lab.problems.contact.contact`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.lab.problems.contact.contact import SPACING, bodies, smooth_ball
from gsfluent.lab.problems.contact.friction import PULL
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box
from gsfluent.lab.world.walls import wall

HALF = 0.5
"""Contact radius in cube roots of a point's volume: a body ends half a point beyond its last."""


def bounce(
    radius: float, speed: float = 0.05, *, surface: float | None = HALF, cfl: float = 0.5
) -> tuple[float, float, float]:
    """Drop an elastic ball onto a floor.

    Args:
        radius: Of the ball [dx].
        speed: Of impact [c].
        surface: Contact radius; None: the floor holds nodes.
        cfl: Courant number.

    Returns:
        Speed kept, largest energy over that at the start, and the impulse that the floor booked
        over the momentum that the ball got.
    """
    points, volume = smooth_ball(radius)
    points = points + torch.tensor([0.13, 0.27, radius + 0.73], dtype=torch.float64)
    world = bodies(
        [points], [torch.tensor([0.0, 0.0, -speed], dtype=torch.float64)], volume=volume,
        dtype=torch.float32, colliders=[wall(2, mode="separate")], surface=surface, cfl=cfl,
    )  # fmt: skip
    mass = float(world.scene.mass.double().sum())
    most = largest_energy(world, 1.6 / speed + 6.0 * radius * speed**-0.2)
    up = float(world.momentum()[2])
    return up / mass / speed, most, float(world.impulse[0, 2]) / (up + mass * speed)


def largest_energy(world: World, span: float) -> float:
    """Run on for a time [dx/c]; largest energy in it over that at its beginning, at least 1."""
    start, most = world.kinetic(), 1.0
    for _ in range(12):  # few: the last step before each look is a short one
        world.run(span / 12)
        most = max(most, (world.kinetic() + world.elastic()) / start)
    return most


def watched(
    world: World, layer: Tensor, touching: float, below: Tensor | None = None
) -> tuple[float, str]:
    """Run on for 200 s; mean gap under a layer of points, and how far it swung, in words.

    Args:
        world: What is at rest by and by.
        layer: Rows of its lowest points.
        touching: How high they are where they touch [dx].
        below: Rows of points above whose mean that counts; above 0 when absent.
    """
    seen: list[float] = []
    for _ in range(20):
        world.run(10.0)
        height = world.position[layer, 2].mean()
        if below is not None:
            height = height - world.position[below, 2].mean()
        seen.append(float(height) - touching)
    return sum(seen) / len(seen), f"mean of 200 s, swing {max(seen) - min(seen):.3f}"


def bounced(
    radius: float, bar: float, kept: float, most: float, note: str, steps: str = ""
) -> Iterator[Result]:
    """What an elastic ball of this radius [dx] keeps, within a bar, and its largest energy."""
    yield compare(
        f"restitution, R = {radius:g} dx{steps}", kept, 1.0, tolerance=bar, source="elastic impact",
        note=f"{note}; damping of the transfer (docs/theory/mpm.md)",
    )  # fmt: skip
    yield compare(
        f"largest energy / first, R = {radius:g} dx{steps}", most, 1.0, tolerance=1e-5,
        source="energy never rises",
    )  # fmt: skip


def rest(cells: int, *, surface: float | None = HALF) -> Iterator[Result]:
    """A cube comes to rest on floors that lie differently to the nodes."""
    pull = 0.002
    for shift in (0.0, 0.37):
        world = bodies(
            [box((0.13, 0.27, shift + 0.1), (cells, cells, cells), SPACING)],
            [torch.zeros(3, dtype=torch.float64)], gravity=(0.0, 0.0, -pull),
            dtype=torch.float32, colliders=[wall(2, shift, mode="separate")], surface=surface,
        )  # fmt: skip
        layer = torch.argsort(world.position[:, 2])[: (2 * cells) ** 2]
        world.run(600.0)
        mean, note = watched(world, layer, 0.5 * SPACING + shift)
        yield compare(
            f"gap under a cube of {cells} cells, floor {shift:g} dx above a node", mean,
            tolerance=0.1, unit="dx", source="touching", name="cube_on_floor",
            note=note,
        )  # fmt: skip


def slide(friction: float, angle: float = 45.0) -> Iterator[Result]:
    """A block slides down an inclined floor: what the floor gives along and across it."""
    slope = math.radians(angle)
    world = bodies(
        [box((0.13, 0.27, 0.0), (6.0, 6.0, 3.0), SPACING)], [torch.zeros(3, dtype=torch.float64)],
        gravity=(PULL * math.sin(slope), 0.0, -PULL * math.cos(slope)), dtype=torch.float32,
        colliders=[wall(2, mode="separate", friction=friction)], surface=HALF,
    )  # fmt: skip
    world.run(40.0)
    before = world.impulse[0].clone()
    world.run(60.0)
    given = world.impulse[0] - before
    seen = -float(given[0] / given[2])
    yield compare(
        "force along over force across", seen, friction, error=seen / friction - 1.0,
        tolerance=0.002, source="Coulomb", name="block_on_floor", note=f"{angle:g} degrees",
    )  # fmt: skip


@problem(tier="fast")
def cube_on_floor() -> Iterator[Result]:
    """A cube rests on a rigid floor where its points end."""
    for cells in (4, 8):
        yield from rest(cells)


@problem(tier="fast")
def ball_on_floor() -> Iterator[Result]:
    """An elastic ball bounces off a rigid floor and makes no energy."""
    for radius, bar in ((6.0, 0.05), (10.0, 0.03)):
        kept, most, _ = bounce(radius)
        yield from bounced(radius, bar, kept, most, "0.05 c")


@problem(tier="fast")
def block_on_floor() -> Iterator[Result]:
    """A block slides down an inclined floor as Coulomb's law says."""
    for friction in (0.25, 0.5, 0.75):
        yield from slide(friction)
