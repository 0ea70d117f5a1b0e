"""Two elastic discs that meet and part (Sulsky et al. 1994)."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsfluent.lab.driver import World
from gsfluent.lab.registry import Result, problem
from gsfluent.lab.shapes import disc, parameters
from gsfluent.lab.vortex import plane_strain

SOURCE = "elastic; Sulsky et al. 1994, solver.md 3, row 7"


def collide(cells: int, fields: int, bounce: float = 0.0) -> tuple[float, float, float, float, str]:
    """Let two discs (r 0.2 m, E 1000, nu 0.3, rho 1000, 0.14 m/s each) meet head-on and part.

    Args:
        cells: Cells per radius.
        fields: 1: they meet in one velocity field; 2: by contact of two.
        bounce: Restitution of the contact at a node.

    Returns:
        Kinetic and whole energy after over before, largest gain of energy, largest momentum over
        sum m |v|, and what else was seen.
    """
    radius, speed = 0.2, 0.1
    dx = radius / cells
    spacing = 0.5 * dx
    one = disc([0.25, 0.25, 0.5 * spacing], radius, spacing, spacing)
    two = disc([0.75, 0.75, 0.5 * spacing], radius, spacing, spacing)
    points = torch.cat([one, two])
    second = torch.arange(points.shape[0]) >= one.shape[0]
    velocity = torch.zeros_like(points)
    velocity[:, :2] = torch.where(second[:, None], -speed, speed).to(velocity)
    volume = spacing**3
    world = World(
        points, velocity, mass=1000.0 * volume, volume=volume, dx=dx, law=0,
        body=second.to(torch.int32) if fields == 2 else None, restitution=bounce,
        params=parameters(1000.0, 0.3, 1000.0), colliders=plane_strain(),
    )  # fmt: skip
    start, ends = world.kinetic(), second.to(world.position.device)
    content = float((1000.0 * volume * velocity.norm(dim=1)).sum())
    lowest, gain, drift = 1.0, 0.0, 0.0
    for _ in range(160):
        world.run(0.02)
        kinetic = world.kinetic()
        lowest = min(lowest, kinetic / start)
        gain = max(gain, (kinetic + world.elastic()) / start - 1.0)
        drift = max(drift, float(world.momentum()[:2].norm()) / content)
    gap = float((world.center(ends) - world.center(~ends)).norm())
    note = (
        f"dx = r / {cells}, CFL 0.5, {world.steps} steps; kinetic energy down to {lowest:.3f}, "
        f"elastic energy left {world.elastic() / start:.3f}; centres {gap:.2f} m apart at the end"
    )
    kept = (world.kinetic() + world.elastic()) / start
    return world.kinetic() / start, kept, gain, drift, note


@problem(tier="fast")
def discs_one_field() -> Iterator[Result]:
    """Two elastic discs in a head-on collision, in one field: energy returned and momentum."""
    back, _, gain, drift, note = collide(16, 1)
    yield Result(
        "discs_one_field", "kinetic energy after over before, one field", back, 1.0, 1.0 - back,
        0.1, "", SOURCE, note=note,
    )  # fmt: skip
    yield Result(
        "discs_one_field", "largest energy gained", gain, 0.0, gain, 1e-3, "", "no work is done"
    )
    yield Result(
        "discs_one_field", "momentum over sum m |v|", drift, 0.0, drift, 1e-12, "",
        "equal and opposite",
    )  # fmt: skip


@problem(tier="slow")
def discs_two_fields() -> Iterator[Result]:
    """Two elastic discs that meet by contact of two fields: energy returned.

    A node that touches for the first time loses its approach. Half of it given back (node
    restitution 0.5) returns more in the end, but the nodes then rattle while the discs touch, and
    the energy swings above what there was: no cure.
    """
    for bounce in (0.0, 0.5):
        back, kept, gain, drift, note = collide(24, 2, bounce)
        yield Result(
            "discs_two_fields", f"kinetic energy after over before, node restitution {bounce:g}",
            back, 1.0, 1.0 - back, 0.1, "", SOURCE, note=f"{note}; energy lost {1.0 - kept:.3f}",
        )  # fmt: skip
        yield Result(
            "discs_two_fields", f"largest energy gained, node restitution {bounce:g}", gain, 0.0,
            gain, 1e-3, "", "no work is done", note=f"momentum over sum m |v| {drift:.1e}",
        )  # fmt: skip
