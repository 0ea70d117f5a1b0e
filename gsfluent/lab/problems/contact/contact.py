"""Two bodies that touch: pulling apart, oblique and head-on impact, discs.

Lengths in cells, P-wave speed 1 m/s, density 1 kg/m^3: what is measured does not depend on the
units. Sliding, rolling and resting: :mod:`gsfluent.lab.problems.contact.friction`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import ball, box, disc, parameters, rotation
from gsfluent.lab.world.walls import PLANE_STRAIN

POISSON = 0.2
YOUNG = (1.0 + POISSON) * (1.0 - 2.0 * POISSON) / (1.0 - POISSON)
"""Of a P-wave modulus of 1 Pa."""
SPACING = 0.5  # 8 points per cell
HERTZ = {0.025: (1.133, 0.874), 0.00625: (1.064, 0.906)}
"""Largest force and contact time of two balls over Hertz's, whose law is of small strains, by the
speed of each [c]: ``ball_on_mirror`` of ``scripts/fracturebench/references.py``, neo-Hookean finite
elements, 32 along a radius (24: the same within 0.1 and 0.2 %); they rebound with 0.999."""


def bodies(
    parts: list[Tensor], velocities: list[Tensor], *, one_field: bool = False, **options: Any
) -> World:
    """A world of elastic bodies with these points and velocities, one velocity field each."""
    count = [len(p) for p in parts]
    body = torch.cat([torch.full((n,), i, dtype=torch.int32) for i, n in enumerate(count)])
    speed = torch.cat([v.expand(n, 3) for v, n in zip(velocities, count, strict=True)])
    volume = SPACING**3
    options = {"volume": volume, "dx": 1.0, "law": 0, **options}
    return World(
        torch.cat(parts), speed, params=options.pop("params", parameters(YOUNG, POISSON, 1.0)),
        body=None if one_field else body, **options,
    )  # fmt: skip


def turning(world: World, of: Tensor) -> Tensor:
    """Angular velocity of a ball [1/s], [3]: angular momentum over the moment of inertia."""
    center = world.center(of)
    arm = world.position[of].double() - center
    mass = world.scene.mass[of].double()
    spin = world.angular_momentum(center, of)  # about the centre: the flight of it gives nothing
    inertia = (mass[:, None] * arm**2).sum() * 2.0 / 3.0 + 0.5 * mass.sum() * world.scene.dx**2
    return spin / inertia


def smooth_ball(radius: float) -> tuple[Tensor, Tensor]:
    """Points on concentric shells around the origin, so that the surface is smooth.

    A lattice ball is rough by a quarter of a cell, and what touches is then steps and not a ball.

    Args:
        radius: [dx], a multiple of the spacing of half a cell.

    Returns:
        Positions [N, 3] and the volume of each point [N].
    """
    points, volumes = [], []
    for shell in range(round(radius / SPACING)):
        middle, inner = (shell + 0.5) * SPACING, shell * SPACING
        count = max(1, round(4.0 * math.pi * (middle / SPACING) ** 2))
        # Fibonacci lattice; every shell turned on, so that no two lie in step
        step = torch.arange(count, dtype=torch.float64) + 0.5
        turn = math.pi * (1.0 + math.sqrt(5.0)) * step + 2.4 * shell
        z = 1.0 - 2.0 * step / count
        flat = (1.0 - z * z).sqrt()
        points.append(middle * torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1))
        whole = 4.0 / 3.0 * math.pi * ((inner + SPACING) ** 3 - inner**3)
        volumes.append(torch.full((count,), whole / count, dtype=torch.float64))
    return torch.cat(points), torch.cat(volumes)


@problem(tier="fast")
def pull_apart(gap: float = 0.0, one_field: bool = False) -> Result:
    """Two touching blocks that leave each other keep their speed.

    Args:
        gap: Between them at the start [dx].
        one_field: Both blocks in one velocity field: they stay glued, which is the failure the
            fields are there to cure.
    """
    speed = 0.01
    size = (4.0, 4.0, 4.0)
    parts = [box((-4.0, 0.0, 0.0), size, SPACING), box((gap, 0.0, 0.0), size, SPACING)]
    away = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    world = bodies(parts, [-away, away], one_field=one_field)
    world.run(0.3 / speed)
    second = torch.arange(len(world.position)) >= len(parts[0])
    mass = float(world.scene.mass[second].sum())
    kept = float(world.momentum(second)[0]) / mass / speed
    return compare(
        "v_end / v_0", kept, 1.0, tolerance=1e-3, source="free flight",
        note="one velocity field" if one_field else "a field per body",
    )  # fmt: skip


def _impact(
    radius: float, angle: float, speed: float, turn: Tensor, **options: Any
) -> tuple[World, list[Tensor], Tensor]:
    """Two balls about to meet; their masks and the line of centres at contact."""
    slope = math.radians(angle)
    line = turn @ torch.tensor([math.cos(slope), math.sin(slope), 0.0], dtype=torch.float64)
    along = turn @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    place = radius * line + 0.5 * along
    shift = torch.tensor([0.13, 0.27, -0.31], dtype=torch.float64)
    points, volume = smooth_ball(radius)
    parts = [points + sign * place + shift for sign in (-1.0, 1.0)]
    volume = torch.cat([volume, volume])
    world = bodies(parts, [speed * along, -speed * along], volume=volume, **options)
    first = torch.arange(len(world.position)) < len(parts[0])
    return world, [first, ~first], line


TURNS = (None, ((1.0, 2.0, 3.0), 0.7), ((-2.0, 1.0, 0.5), 1.9))


@problem(tier="slow")
def oblique_spheres(
    radius: float = 7.0, one_field: bool = False, turns: int = 3
) -> Iterator[Result]:
    """Frictionless balls that meet at 45 degrees leave without spin."""
    speed = 0.05
    for number, turn in enumerate(TURNS[:turns]):
        q = torch.eye(3, dtype=torch.float64) if turn is None else rotation(*turn)
        world, balls, _ = _impact(radius, 45.0, speed, q, one_field=one_field)
        world.run(1.0 / speed + 6.0 * radius * speed**-0.2)
        axis = q @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        spin = [float(turning(world, of).cpu() @ axis) * radius / speed for of in balls]
        worst = max(spin, key=abs)
        yield compare(
            f"omega R / v_0, direction {number}", worst, tolerance=0.02,
            source="no friction, no torque", note=f"both balls {spin[0]:+.4f} {spin[1]:+.4f}",
        )  # fmt: skip


def hertz(
    radius: float, speed: float, *, one_field: bool = False, touch: bool = True
) -> list[Result]:
    """Head-on elastic balls: largest force and time of contact over Hertz's, and restitution.

    Args:
        radius: Of both [dx].
        one_field: Both in one velocity field.
        speed: Of each [c], one of :data:`HERTZ`.
        touch: Whether points push each other; else nodes exchange impulses.

    Returns:
        Force, time and restitution.
    """
    chosen = TURNS[1]
    q = torch.eye(3, dtype=torch.float64) if chosen is None else rotation(*chosen)
    world, balls, line = _impact(
        radius, 0.0, speed, q, one_field=one_field, surface=0.5 if touch else None, touch=touch
    )
    mass = float(world.scene.mass[balls[0]].sum())
    stiffness = YOUNG / (1.0 - POISSON**2) / 2.0  # E* of two equal bodies
    reduced, curve, meeting = mass / 2.0, radius / 2.0, 2.0 * speed
    depth = (15.0 * reduced * meeting**2 / (16.0 * stiffness * math.sqrt(curve))) ** 0.4
    force = 4.0 / 3.0 * stiffness * math.sqrt(curve) * depth**1.5
    time = 2.87 * (reduced**2 / (curve * stiffness**2 * meeting)) ** 0.2
    pushes: list[tuple[float, float]] = []
    last = [float(world.momentum(balls[0]).cpu() @ line), 0.0]

    def watch(now: World) -> None:
        given = float(now.momentum(balls[0]).cpu() @ line)
        pushes.append((now.time, (last[0] - given) / (now.time - last[1])))
        last[:] = [given, now.time]

    world.run(1.0 / meeting + 2.0 * time, each=watch)
    touching = [t for t, f in pushes if f > 0.02 * force]
    after = -float(world.momentum(balls[0]).cpu() @ line) / mass / speed
    source = "Hertz (Johnson 1985), by finite elements of the same law"
    note = f"R = {radius:g} dx, v = {speed:g} c each, deepest {depth:.2f} dx"
    note += "; points push" if touch else "; nodes push"
    most, span = HERTZ[speed]
    return [
        compare(
            "largest force / Hertz", max(f for _, f in pushes) / force, most, tolerance=0.05,
            source=source, note=note,
        ),
        compare(
            "contact time / Hertz", (touching[-1] - touching[0]) / time, span, tolerance=0.05,
            source=source, note=note,
        ),
        compare(
            "restitution", after, 1.0, tolerance=0.05, source="elastic impact",
            note=f"{note}; damping of the transfer (docs/theory/contact.md)",
        ),
    ]  # fmt: skip


@problem(tier="slow")
def hertz_spheres() -> Iterator[Result]:
    """Head-on elastic balls whose points push: force, time, restitution; and what nodes give."""
    points, nodes = (hertz(7.0, 0.025, touch=touch) for touch in (True, False))
    for push, stop in zip(points, nodes, strict=True):
        yield dataclasses.replace(push, note=f"{push.note}; where nodes push {stop.value:.3f}")


@problem(tier="slow")
def hertz_spheres_points() -> list[Result]:
    """The same balls, finer, at a quarter of the speed."""
    return hertz(10.0, 0.00625)


@problem(tier="slow")
def hertz_axis() -> Iterator[Result]:
    """Head-on lattice balls along an axis of the grid: the setting of solver.md 0, finding 5.

    There contact of two fields acts wherever both have mass, 1.5 to 2.5 cells before they touch.
    """
    speed = 0.05
    radius = 7.2
    points = ball([0.0, 0.0, 0.0], radius, SPACING)
    along = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    place = torch.tensor([radius + 0.5, 0.0, 0.0], dtype=torch.float64)
    shift = torch.tensor([0.13, 0.27, -0.31], dtype=torch.float64)
    for one_field, gap in ((True, 1.0), (False, 2.0)):
        parts = [points - place + shift, points + place + shift]
        world = bodies(parts, [along, -along], one_field=one_field, contact_gap=gap)
        first = torch.arange(len(world.position)) < len(points)
        world.run(0.5 / speed + 20.0 * radius * (2.0 * speed) ** -0.2)
        after = -float(world.momentum(first)[0] / world.scene.mass[first].sum()) / speed
        yield compare(
            f"restitution, {'one field' if one_field else 'two fields, no gate'}", after, 1.0,
            tolerance=0.05, source="solver.md 0, finding 5: 0.953 to 0.972",
            note=f"R = {radius:g} dx, v = {speed:g} c each, {len(points)} points each",
        )  # fmt: skip


def discs_meet(touch: bool, cells: int = 8) -> tuple[World, list[float]]:
    """Two elastic discs in plane strain meet, 0.12 c each; how they end.

    Args:
        touch: Whether points push each other; else nodes exchange impulses.
        cells: Their radius.

    Returns:
        The world, and over its kinetic energy at the start: that at the end, the least on the way,
        kinetic and elastic energy at the end, the most of both, and what their centres have.
    """
    dx = 0.2 / cells
    spacing = dx / 2.0
    parts = [disc((c, c, 0.5 * dx), 0.2, dx, spacing) for c in (0.3, 0.7)]
    push = torch.tensor([0.1, 0.1, 0.0], dtype=torch.float64)
    world = bodies(
        parts, [push, -push], dx=dx, volume=spacing**3, colliders=[PLANE_STRAIN],
        params=parameters(1000.0, 0.3, 1000.0), surface=0.5 if touch else None, touch=touch,
    )  # fmt: skip
    start = world.kinetic()
    least, most = [1.0], [1.0]

    def watch(now: World) -> None:
        least[0] = min(least[0], now.kinetic() / start)
        most[0] = max(most[0], (now.kinetic() + now.elastic()) / start)

    world.run(3.0, each=watch)
    moving = world.kinetic() / start
    one = torch.arange(len(world.position), device=world.position.device) < len(parts[0])
    pace = world.momentum(one).double() / world.scene.mass[one].sum()
    centres = float(pace @ pace) / float(push @ push)  # both alike
    return world, [moving, least[0], moving + world.elastic() / start, most[0], centres]


@problem(tier="slow")
def colliding_discs() -> list[Result]:
    """Two elastic discs meet and part (Sulsky et al. 1994).

    They meet so fast that they ring afterwards, so it is the sum of kinetic and elastic energy that
    an elastic impact keeps: 0.925, 0.960, 0.977 of it at 8, 16, 32 cells a radius. The centres keep
    0.81, 0.82, 0.82 of theirs; the rest rings.
    """
    world, (moving, least, kept, most, centres) = discs_meet(touch=True)
    at_nodes = discs_meet(touch=False)[1][2]
    source = "Sulsky, Chen & Schreyer 1994"
    drift = float(world.momentum().norm()) / (0.1 * float(world.scene.mass.sum()))
    return [
        compare(
            "kinetic and elastic energy after / before", kept, 1.0, tolerance=0.1, source=source,
            note=f"points push; kinetic alone {moving:.3f}, at least {least:.2f} on the way; at "
            f"nodes {at_nodes:.3f}",
        ),
        compare(
            "kinetic energy of the centres after / before", centres, 0.818, tolerance=0.03,
            source="16 and 32 cells a radius: 0.821 and 0.816", note="what is missing rings",
        ),
        compare(
            "largest energy / first", most, 1.0, tolerance=1e-3, source="energy never rises"
        ),
        compare("momentum", drift, tolerance=1e-6, source="conservation"),
    ]  # fmt: skip
