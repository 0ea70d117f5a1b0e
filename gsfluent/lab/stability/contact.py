"""Maps of contact: bodies that should part freely, and bodies that should not feel each other."""

from __future__ import annotations

import torch

from gsfluent.lab.stability.maps import Axis, Map, Outcome, Place
from gsfluent.lab.stability.scenes import DENSITY, DX, YOUNG, watched
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.invariants import Limits
from gsfluent.lab.world.shapes import box, parameters, wave_speed

TWO, ONE = "a field per body", "one field"
POINT = (0.5 * DX) ** 3


def pair(gap: float, speed: float, fields: str, place: Place, **options: float) -> World:
    """Two cubes side by side, ``gap`` dx apart, each moving along x by ``speed`` (+: apart)."""
    row = parameters(YOUNG, 0.3, DENSITY)
    one = box([0.013, 0.021, 0.037], [0.3, 0.3, 0.3], 0.5 * DX)
    other = one + torch.tensor([0.3 + gap * DX, 0.0, 0.0])
    body = torch.cat([torch.zeros(len(one)), torch.ones(len(other))]).int()
    velocity = torch.zeros(2 * len(one), 3, dtype=torch.float64)
    velocity[:, 0] = torch.where(body == 1, speed, -speed)
    return World(
        torch.cat([one, other]), velocity, volume=POINT, dx=DX, law=0,
        params=row, body=body if fields == TWO else None, dtype=torch.float32,
        device=place.device, **options,  # type: ignore[arg-type]
    )  # fmt: skip


def part_point(gap: float, mach: float, variant: str, place: Place) -> Outcome:
    """Two cubes leave each other: each keeps its momentum."""
    world = pair(gap, mach * wave_speed(parameters(YOUNG, 0.3, DENSITY)), variant, place)
    half = len(world.scene.mass) // 2
    return watched(world, 200, place, group=torch.arange(2 * half) // half)


FIELDS_MAP = Map(
    "fields", "Two bodies part",
    Axis("gap", "gap at the start [dx]",
         (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.25, 2.5, 3.0), 0.0, setting=False,
         log=False),
    Axis("mach", "speed over wave speed, v / c", (1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.3), 1e-2,
         setting=False),
    (TWO, ONE), part_point, "test_boundary_gap_of_two_bodies_in_one_field",
    "Each body must keep its momentum (1e-5): in one field they are glued as long as they "
    "share nodes, up to a gap of 2 dx.", gpu=True,
)  # fmt: skip


def early_point(reach: float, gap: float, variant: str, place: Place) -> Outcome:
    """Two cubes approach until a gap is left: nothing may have happened so far."""
    mach, way = 0.02, 0.3
    world = pair(
        gap + way, -mach * wave_speed(parameters(YOUNG, 0.3, DENSITY)), variant, place,
        contact_gap=reach,
    )  # fmt: skip
    steps = int(way * (1.0 + mach) / (2.0 * mach * 0.5))
    half = len(world.scene.mass) // 2
    # the solver's own rounding is 1e-6 of the momentum; a touch is a thousand times that
    return watched(
        world, steps, place, group=torch.arange(2 * half) // half, limits=Limits(momentum=1e-5)
    )


EARLY_CONTACT_MAP = Map(
    "early_contact", "Two bodies that have not touched yet",
    Axis("reach", "contact_gap [dx]",
         (0.6, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 1.75, 2.0, 2.5), 1.0),
    Axis("gap", "gap that is left [dx]",
         (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5), 0.5, setting=False,
         span=(0.3, 2.5), log=False),
    (TWO, ONE), early_point, "test_boundary_contact_before_touching",
    "One field does not know a contact_gap: bodies feel each other across 1.5 dx. What is left "
    "below 0.25 dx is contact.",
)  # fmt: skip
