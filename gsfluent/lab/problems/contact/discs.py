"""Two elastic discs that meet and part (Sulsky et al. 1994)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import disc, parameters
from gsfluent.lab.world.walls import PLANE_STRAIN

PARTED = 2.2
"""Time from which on the discs do not touch any more [s]."""
SOURCE = "elastic; Sulsky et al. 1994, solver.md 3, row 7"


def collide(cells: int, fields: int) -> tuple[float, float, float, float, str]:
    """Let two discs (r 0.2 m, E 1000, nu 0.3, rho 1000, 0.14 m/s each) meet head-on and part.

    Parted they swing, and kinetic energy with them: how much of it comes back is the most that is
    there in any later look, not that at a time of the observer's choice.

    Returns:
        Kinetic energy that comes back and whole energy after, over that before, largest gain of
        energy, largest momentum over sum m |v|, and what else was seen.
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
        points, velocity, volume=volume, dx=dx, law=0,
        body=second.to(torch.int32) if fields == 2 else None,
        params=parameters(1000.0, 0.3, 1000.0), colliders=[PLANE_STRAIN],
    )  # fmt: skip
    start, ends = world.kinetic(), second.to(world.position.device)
    content = float((1000.0 * volume * velocity.norm(dim=1)).sum())
    lowest, back, least, gain, drift = 1.0, 0.0, 1.0, 0.0, 0.0
    for _ in range(160):
        world.run(0.02)
        kinetic = world.kinetic()
        lowest = min(lowest, kinetic / start)
        if world.time > PARTED:
            back, least = max(back, kinetic / start), min(least, kinetic / start)
        gain = max(gain, (kinetic + world.elastic()) / start - 1.0)
        drift = max(drift, float(world.momentum()[:2].norm()) / content)
    gap = float((world.center(ends) - world.center(~ends)).norm())
    note = (
        f"dx = r / {cells}, CFL 0.5, {world.steps} steps; kinetic energy down to {lowest:.3f}, "
        f"then {least:.3f} to {back:.3f}; centres {gap:.2f} m apart at the end"
    )
    kept = (world.kinetic() + world.elastic()) / start
    return back, kept, gain, drift, note


@problem(tier="fast")
def discs_one_field() -> Iterator[Result]:
    """Two elastic discs in a head-on collision, in one field: energy returned and momentum."""
    back, _, gain, drift, note = collide(16, 1)
    yield compare(
        "kinetic energy after over before, one field", back, 1.0, error=1.0 - back, tolerance=0.1,
        source=SOURCE, note=note,
    )  # fmt: skip
    yield compare("largest energy gained", gain, tolerance=1e-3, source="no work is done")
    yield compare("momentum over sum m |v|", drift, tolerance=1e-12, source="equal and opposite")


@problem(tier="slow")
def discs_two_fields() -> Iterator[Result]:
    """Two elastic discs that meet by contact of two fields: energy returned.

    A node that touches loses its approach: the loss falls with dx, first order (energy lost 0.148,
    0.107, 0.077, 0.060, 0.042 at 12, 16, 24, 32, 48 cells per radius).
    """
    lost = []
    for cells in (12, 24):
        back, kept, gain, drift, note = collide(cells, 2)
        lost.append(1.0 - kept)
    yield compare(
        "kinetic energy after over before, two fields", back, 1.0, error=1.0 - back, tolerance=0.1,
        source=SOURCE, note=f"{note}; energy lost {lost[1]:.3f}",
    )  # fmt: skip
    yield compare(
        "largest energy gained, two fields", gain, tolerance=1e-3, source="no work is done",
        note=f"momentum over sum m |v| {drift:.1e}",
    )  # fmt: skip
    order = math.log2(lost[0] / lost[1])
    yield compare(
        "order of the energy lost, r / 12 to r / 24", order, 1.0, error=max(0.0, 1.0 - order),
        tolerance=0.2, source="order 1; solver.md 3, row 7",
    )  # fmt: skip
