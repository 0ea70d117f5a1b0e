"""Kalthoff-Winkler test: a notch loaded in shear cracks in tension, at seventy degrees."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import nacc, parameters, sheet
from gsfluent.lab.world.walls import between_planes, wall
from gsfluent.pipeline.matter.crack_band import crack_band

YOUNG, POISSON, DENSITY = 190e9, 0.3, 8000.0
SIDE, NOTCH, HEIGHT = 0.1, 0.05, 0.025


@dataclasses.dataclass(frozen=True)
class Crack:
    """Median direction of the crack from the tip of the notch [degrees], and its length [m]."""

    angle: float
    length: float


def shear_notch(cells: int) -> Crack:
    """Hit the edge of a maraging-steel plate under its notch; half of the symmetric test.

    100 mm square, notch of 50 mm at 25 mm from the plane of symmetry; a projectile of the same
    steel, 50 mm long, gives the edge half its speed. Fracture energy 22 kJ/m^2 (18Ni1900). The
    tensile strength is 0.5 GPa, half of the real one: ``E G / sigma^2``, the length a crack needs
    to soften, is then 16 mm and 8 to 10 cells, where the real 4 mm would be two.
    """
    dx, softening = SIDE / cells, 0.0172
    row = nacc(
        YOUNG, POISSON, DENSITY, friction=2.0, cohesion=0.05, hardening=math.asinh(0.05) / softening
    )
    row, alpha = crack_band(
        row, torch.tensor(-softening, dtype=torch.float64), dx=dx, reference=SIDE / 64.0
    )
    plate = sheet([0.0, 0.0], [SIDE, SIDE], dx)
    open_ = (plate[:, 0] < NOTCH) & ((plate[:, 1] - HEIGHT).abs() < 0.76 * dx)
    plate = plate[~open_]
    projectile = sheet([-0.05, 0.0], [0.05, HEIGHT - dx], dx)
    points = torch.cat([plate, projectile])
    velocity = torch.zeros_like(points)
    velocity[len(plate) :, 0] = 33.0
    # what is crushed at the edge or lies on the plane of symmetry is no part of the question
    breakable = (points[:, 0] > 0.1 * SIDE) & (points[:, 1] > 3.0 * dx)
    breakable[len(plate) :] = False
    volume = 0.25 * dx**3
    start = torch.tensor([dx * round(0.05 / dx + 4.0), 0.0, 0.0], dtype=torch.float64)
    world = World(
        points + start, velocity, volume=volume, dx=dx,
        law=torch.tensor([0, 1]), params=torch.stack([parameters(YOUNG, POISSON, DENSITY), row]),
        material=breakable.int(), alpha=torch.full_like(points[:, 0], float(alpha)),
        colliders=[*between_planes(dx), wall(1)], dtype=torch.float32,
    )  # fmt: skip
    world.run(seconds=80e-6)
    broken = points[breakable & (world.peak >= 0.0).cpu(), :2]
    arm = broken - torch.tensor([NOTCH, HEIGHT], dtype=torch.float64)
    reach = arm.norm(dim=1)
    above = (arm[:, 1] > 0.0) & (reach > 0.004)  # beyond the blunt tip
    if not bool(above.any()):
        return Crack(math.nan, 0.0)
    angle = torch.rad2deg(torch.atan2(arm[above, 1], arm[above, 0]))
    return Crack(float(angle.median()), float(reach[above].max()))


@problem(tier="fast")
def kalthoff_winkler() -> Iterator[Result]:
    """Kalthoff-Winkler: shear on a notch opens a tensile crack at 70 degrees, on two grids."""
    cells = (48, 64)
    for n in cells:
        crack = shear_notch(n)
        # tests and codes report 63 to 70 degrees: the error is the distance to that range
        off = max(63.0 - crack.angle, crack.angle - 70.0, 0.0) if crack.length else math.inf
        yield compare(
            f"direction of the crack, {n} cells", crack.angle, 70.0, error=off, tolerance=7.0,
            unit="degrees", source="Kalthoff and Winkler 1988; solver.md 3 row 20",
            note=f"63 to 70 reported; length {crack.length * 1e3:.0f} mm",
        )  # fmt: skip
