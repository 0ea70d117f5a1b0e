"""Taylor bar: a copper cylinder that hits a rigid wall."""

from __future__ import annotations

import math

import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters
from gsfluent.lab.world.walls import wall

VON_MISES = 3


@problem(tier="fast")
def taylor_bar() -> list[Result]:
    """Taylor bar: final length and foot of a copper cylinder at 227 m/s after 80 microseconds.

    32.4 mm x 6.4 mm; E 117 GPa, nu 0.35, 8930 kg/m^3, yield stress 400 MPa, linear hardening 100
    MPa; a quarter between two planes of symmetry, frictionless wall. The end of a point's cell is
    its position plus its stretched half spacing.
    """
    radius, length, density = 3.2e-3, 32.4e-3, 8930.0
    dx = radius / 4
    step = 0.5 * dx
    size = [radius + step, radius + step, round(length / step) * step]
    points = box([0.0, 0.0, 0.0], size, step)
    points = points[points[:, :2].norm(dim=1) <= radius]
    start = float(points[:, 2].max()) + 0.5 * step
    volume = 0.25 * math.pi * radius**2 * start / points.shape[0]
    world = World(
        points, [0.0, 0.0, -227.0], volume=volume, dx=dx, law=VON_MISES,
        params=parameters(117e9, 0.35, density, c2=400e6, c4=100e6),
        colliders=[wall(0), wall(1), wall(2, mode="separate")],
        deformation=True, dtype=torch.float32,
    )  # fmt: skip
    world.run(seconds=80e-6)
    assert world.deformation is not None
    position, stretch = world.position.double().cpu(), world.deformation.double().cpu()
    top = int(position[:, 2].argmax())
    end = float(position[top, 2] + 0.5 * step * stretch[top, 2, 2])
    distance = position[:, :2].norm(dim=1)
    rim = int(distance.argmax())
    outward = points[rim, :2] / points[rim, :2].norm()
    foot = float(distance[rim] + 0.5 * step * (stretch[rim, :2, :2] @ outward).norm())
    source = "solver.md 3 row 14: 21.4 mm, 7.0 to 7.2 mm; Wilkins and Guinan 1973"
    return [
        compare(
            "final length", end * 1e3, 21.4 * start / length, tolerance=0.03, unit="mm",
            source=source, note=f"{points.shape[0]} points in a quarter",
        ),
        compare("radius of the foot", foot * 1e3, 7.1, tolerance=0.07, unit="mm", source=source),
    ]  # fmt: skip
