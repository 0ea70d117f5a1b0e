"""Bodies whose points push each other: where they touch, what a bounce keeps, friction.

Units as in :mod:`gsfluent.lab.problems.contact.contact`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.lab.problems.contact.contact import SPACING, bodies, smooth_ball
from gsfluent.lab.problems.contact.floor import HALF, bounced, largest_energy, watched
from gsfluent.lab.problems.contact.friction import PULL
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box
from gsfluent.lab.world.walls import wall

REST = torch.zeros(3, dtype=torch.float64)


def head_on(
    radius: float,
    speed: float = 0.05,
    *,
    touch: bool = True,
    cfl: float = 0.5,
    flip: float = 0.0,
) -> tuple[float, float, float]:
    """Let two elastic balls meet head-on.

    Args:
        radius: Of both [dx].
        speed: Of each [c].
        touch: Whether points push each other; else nodes exchange impulses.
        cfl: Courant number.
        flip: Share of their own motion that points keep.

    Returns:
        Speed kept, largest energy over that at the start, and the momentum that appeared over that
        of one ball.
    """
    points, volume = smooth_ball(radius)
    place = torch.tensor([radius + 0.5, 0.0, 0.0], dtype=torch.float64)
    shift = torch.tensor([0.13, 0.27, -0.31], dtype=torch.float64)
    along = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    world = bodies(
        [points - place + shift, points + place + shift], [along, -along],
        volume=torch.cat([volume, volume]), dtype=torch.float32, cfl=cfl, flip=flip,
        surface=HALF if touch else None, touch=touch,
    )  # fmt: skip
    first = torch.arange(len(world.position)) < len(points)
    most = largest_energy(world, 1.0 / speed + 6.0 * radius * speed**-0.2)
    before = float(world.scene.mass[first].double().sum()) * speed
    back = -float(world.momentum(first)[0]) / before
    return back, most, float(world.momentum().norm()) / before


def _on_block(
    top: Tensor, size: tuple[float, float], gravity: tuple[float, float, float], friction: float,
    touch: bool,
) -> tuple[World, int]:  # fmt: skip
    """A body on a block of 3 cells that stands on a sticky floor; how many points it has."""
    under = box((-2.0, -2.0, -3.0), (*size, 3.0), SPACING)
    world = bodies(
        [top, under], [REST, REST], gravity=gravity, dtype=torch.float32, friction=friction,
        colliders=[wall(2, -2.0, mode="sticky")], surface=HALF if touch else None, touch=touch,
    )  # fmt: skip
    return world, len(top)


def rest(cells: int, *, touch: bool = True) -> Iterator[Result]:
    """A cube comes to rest on a block whose points lie differently to its own."""
    for shift in (0.0, 0.19):
        top = box((shift, 1.7 * shift, 0.05), (cells, cells, cells), SPACING)
        world, count = _on_block(top, (cells + 4.0, cells + 4.0), (0.0, 0.0, -0.002), 0.0, touch)
        layer = torch.argsort(world.position[:count, 2])[: (2 * cells) ** 2]
        below = world.position[count:]
        face = (below[:, 2] > -SPACING) & (below[:, :2] > 0.5).all(1)
        face &= (below[:, :2] < cells - 0.5).all(1)
        world.run(300.0)
        mean, note = watched(world, layer, SPACING, count + face.nonzero()[:, 0])
        yield compare(
            f"gap under a cube of {cells} cells, shifted by {shift:g} dx", mean,
            tolerance=0.1, unit="dx", source="touching", name="cube_on_block",
            note=note,
        )  # fmt: skip


def slide(friction: float, angle: float = 45.0) -> Result:
    """A block slides down another: what it is given along and across it."""
    slope = math.radians(angle)
    pull = (PULL * math.sin(slope), 0.0, -PULL * math.cos(slope))
    world, count = _on_block(
        box((0.0, 1.0, 0.0), (8.0, 6.0, 3.0), SPACING), (22.0, 10.0), pull, friction, True
    )
    block = torch.arange(len(world.position)) < count
    world.run(40.0)
    before = world.momentum(block)
    world.run(60.0)
    mass = float(world.scene.mass[block].double().sum())
    given = (world.momentum(block) - before) / mass - 60.0 * torch.tensor(pull).to(before)
    return compare(
        "force along over force across", -float(given[0] / given[2]), friction,
        error=-float(given[0] / given[2]) / friction - 1.0, tolerance=0.03, source="Coulomb",
        name="block_on_block", note=f"{angle:g} degrees",
    )  # fmt: skip


@problem(tier="fast")
def balls_head_on() -> Iterator[Result]:
    """Elastic balls bounce off each other and make neither energy nor momentum."""
    for radius, bar in ((6.0, 0.05), (10.0, 0.03)):
        kept, most, drift = head_on(radius)
        yield from bounced(radius, bar, kept, most, "0.05 c each; points push")
        yield compare(
            f"momentum, R = {radius:g} dx", drift, tolerance=1e-6, source="conservation",
        )  # fmt: skip


@problem(tier="slow")
def balls_head_on_short() -> Iterator[Result]:
    """The same by shorter steps, points keeping what these would lose."""
    for cfl in (0.25, 0.125):
        for radius, bar in ((6.0, 0.05), (10.0, 0.03)):
            kept, most, _ = head_on(radius, cfl=cfl, flip=1.0 - 2.0 * cfl)
            note = f"0.05 c each; points push; keep {1.0 - 2.0 * cfl:g} of their own motion"
            yield from bounced(radius, bar, kept, most, note, f", CFL {cfl:g}")


@problem(tier="fast")
def cube_on_block() -> Iterator[Result]:
    """A cube rests on a block where the points of both end."""
    for cells in (4, 8):
        yield from rest(cells)


@problem(tier="fast")
def block_on_block() -> Iterator[Result]:
    """A block slides down another as Coulomb's law says."""
    for friction in (0.25, 0.5, 0.75):
        yield slide(friction)
