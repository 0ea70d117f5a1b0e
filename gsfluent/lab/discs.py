"""Two elastic discs that meet and part (Sulsky et al. 1994)."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsfluent.lab.driver import World
from gsfluent.lab.registry import Result, problem
from gsfluent.lab.shapes import disc, parameters
from gsfluent.lab.vortex import plane_strain


@problem(tier="fast")
def colliding_discs() -> Iterator[Result]:
    """Two elastic discs in a head-on collision: energy returned, momentum, force at the middle."""
    radius, dx, speed = 0.2, 1.0 / 40.0, 0.1
    spacing = 0.5 * dx
    one = disc([0.25, 0.25, 0.5 * spacing], radius, spacing, spacing)
    two = disc([0.75, 0.75, 0.5 * spacing], radius, spacing, spacing)
    points = torch.cat([one, two])
    body = torch.zeros(points.shape[0], dtype=torch.int32)
    body[one.shape[0] :] = 1
    velocity = torch.zeros_like(points)
    velocity[:, :2] = torch.where(body[:, None] == 0, speed, -speed).to(velocity)
    volume = spacing**3
    world = World(
        points, velocity, mass=1000.0 * volume, volume=volume, dx=dx, law=0, body=body,
        params=parameters(1000.0, 0.3, 1000.0), colliders=plane_strain(),
    )  # fmt: skip
    start = world.kinetic()
    content = float((1000.0 * volume * velocity.norm(dim=1)).sum())
    lowest, highest, drift = [start], [start], [0.0]

    def watch(world: World) -> None:
        kinetic = world.kinetic()
        lowest.append(kinetic)
        highest.append(kinetic + world.elastic())
        drift.append(float(world.momentum()[:2].norm()) / content)

    world.run(3.2, each=watch)
    gap = float((world.center(body == 1) - world.center(body == 0)).norm())
    note = (
        f"two fields, dx = r / 8, CFL 0.5, {world.steps} steps; kinetic energy down to "
        f"{min(lowest) / start:.3f}; centres {gap:.2f} m apart at the end"
    )
    back = world.kinetic() / start
    yield Result(
        "colliding_discs", "kinetic energy after over before", back, 1.0, 1.0 - back, 0.1, "",
        "elastic; Sulsky et al. 1994, solver.md 3, row 7", note=note,
    )  # fmt: skip
    gained = max(highest) / start - 1.0
    yield Result(
        "colliding_discs", "largest energy gained", max(gained, 0.0), 0.0, max(gained, 0.0), 1e-3,
        "", "no work is done",
    )  # fmt: skip
    yield Result(
        "colliding_discs", "momentum over sum m |v|", max(drift), 0.0, max(drift), 1e-12, "",
        "equal and opposite",
    )  # fmt: skip
