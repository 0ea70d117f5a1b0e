"""Brazilian test: a disc pressed across its diameter splits along it, from the centre."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import nacc, parameters, sheet, wave_speed
from gsfluent.lab.world.walls import between_planes

YOUNG, POISSON, DENSITY = 1e9, 0.2, 1000.0
DIAMETER = 1.0


def loaded_disc(
    cells: int,
    *,
    half_angle: float,
    tension: float,
    crossings: float,
    row: Tensor,
    breakable: float = 0.0,
    alpha: float = 0.0,
) -> tuple[World, Tensor, float]:
    """A disc between two arcs of even radial pressure that grows linearly in time.

    Args:
        cells: Cells along the radius.
        half_angle: Half the opening of each loaded arc [rad].
        tension: ``2 P / (pi D t)`` at the end of the ramp [Pa].
        crossings: Duration of the ramp in travel times of a pressure wave across the disc. The
            motion is damped with a rate of one per crossing.
        row: NACC row of the part that can break.
        breakable: Its height, in radii from the centre; outside the disc is elastic.
        alpha: Its alpha at the start.

    Returns:
        The world, the points at rest [N, 3] with the centre at 0, and dx.
    """
    radius = 0.5 * DIAMETER
    dx = radius / cells
    c = wave_speed(row)
    points = sheet([-radius, -radius], [DIAMETER, DIAMETER], dx)
    points = points[points[:, :2].norm(dim=1) <= radius]
    distance = points[:, :2].norm(dim=1)
    angle = torch.atan2(points[:, 0].abs(), points[:, 1].abs())
    loaded = (distance > radius - 0.71 * dx) & (angle < half_angle)
    push = -points[loaded, :2] / distance[loaded, None]
    upper = points[loaded, 1] > 0.0
    force = 0.5 * math.pi * DIAMETER * dx * tension  # P of a slab of thickness dx
    push = push * (force / -float(push[upper, 1].sum()))
    volume = 0.25 * dx**3
    mass = DENSITY * volume

    def press(world: World, dt: float) -> None:
        share = min(1.0, world.time * c / (crossings * DIAMETER))
        v = world.velocity * (1.0 - dt * c / DIAMETER)
        v[loaded, :2] += (push * (share * dt / mass)).to(v)
        world.velocity = v

    world = World(
        points, [0.0, 0.0, 0.0], volume=volume, dx=dx, law=torch.tensor([0, 1]),
        params=torch.stack([parameters(YOUNG, POISSON, DENSITY), row]),
        material=(points[:, 1].abs() < breakable * radius).int(),
        alpha=torch.full_like(points[:, 0], alpha), colliders=between_planes(dx),
        dtype=torch.float32, force=press,
    )  # fmt: skip
    return world, points, dx


@problem(tier="fast")
def brazilian_disc() -> list[Result]:
    """Brazilian disc: stress at the centre, first damage there, crack along the loaded diameter.

    The stress is that of an elastic disc under a load that hardly moves. The breaking disc has
    elastic caps (beyond three quarters of the radius), because NACC crushes where a load enters.
    NACC is no tension cut-off: the mean stress in the centre of a disc is compressive, and what
    breaks there is the combination of shear and little pressure.
    """
    source = "Hondros 1959; solver.md 3 row 17"
    half_angle, softening, strength = 0.1, 0.005, 0.005
    row = nacc(
        YOUNG, POISSON, DENSITY, friction=2.4, cohesion=0.05,
        hardening=math.asinh(strength) / softening,
    )  # fmt: skip
    c, tension = wave_speed(row), 5e-4 * YOUNG
    world, points, dx = loaded_disc(
        12, half_angle=half_angle, tension=tension, crossings=16.0, row=row
    )
    world.run(seconds=19.0 * DIAMETER / c)
    centre = points[:, :2].norm(dim=1) < 1.5 * dx
    stress = world.stress[centre].double().mean(dim=0) / tension
    wide = math.sin(2.0 * half_angle) / half_angle
    results = [
        compare(
            "tensile stress at the centre over 2P/(pi D t)", float(stress[0]), wide - 1.0,
            tolerance=0.05, source=source,
        ),
        compare(
            "stress along the load over 2P/(pi D t)", float(stress[1]), -wide - 1.0, tolerance=0.05,
            source=source,
        ),
    ]  # fmt: skip

    world, points, dx = loaded_disc(
        12, half_angle=0.15, tension=2.0 * strength * YOUNG, crossings=20.0, row=row,
        breakable=0.75, alpha=-softening,
    )  # fmt: skip
    first: list[float] = []

    def watch(w: World) -> None:
        broken = (w.alpha >= 0.0).cpu()
        if not first and bool(broken.any()):
            first.append(float(points[broken, :2].norm(dim=1).mean()) / dx)

    while not first and world.time < 12.0 * DIAMETER / c:
        world.run(seconds=0.25 * DIAMETER / c, each=watch)
    world.run(seconds=1.5 * DIAMETER / c)
    broken = points[(world.alpha >= 0.0).cpu(), :2].abs()
    middle = broken[broken[:, 1] < 0.25 * DIAMETER]
    place = first[0] if first else math.nan
    width = float(middle[:, 0].max()) / dx if len(middle) else math.nan
    reach = float(broken[:, 1].max()) / (0.5 * DIAMETER) if len(broken) else math.nan
    source = "splitting from the centre; solver.md 3 row 17"
    return [
        *results,
        compare(
            "first broken point from the centre", place, tolerance=2.0, unit="dx", source=source,
        ),
        compare(
            "half width of the crack, middle half", width, tolerance=2.0, unit="dx", source=source,
        ),
        compare(
            "reach of the crack along the diameter", reach, 0.75, tolerance=0.1, unit="radii",
            source=source, note="0.75 is all that can break",
        ),
    ]  # fmt: skip
