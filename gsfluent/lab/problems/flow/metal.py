"""Taylor bars: copper cylinders that hit a rigid wall."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters
from gsfluent.lab.world.walls import wall

VON_MISES = 3


class Size(NamedTuple):
    """Of a bar before it hits [m]."""

    radius: float
    length: float


class Bar(NamedTuple):
    """A bar after its impact [m]."""

    length: float
    foot: float  # radius at the wall
    bulge: float  # radius at a fifth of the first length
    start: float  # length of its points before
    points: int


ANNEALED = Size(3.81e-3, 25.4e-3)


def johnson_cook_copper() -> Tensor:
    """Row of annealed OFHC copper, [8]: constants of Johnson and Cook 1983, with m = 1 (1.09)."""
    density, heat = 8960.0, 383.0 * (1356.0 - 298.0) / 0.9
    return parameters(124e9, 0.34, density, c2=90e6, c4=292e6, c7=0.31, c3=0.025, c5=density * heat)


def fitted_copper() -> Tensor:
    """The same metal by a linear hardening that was fitted to its bars, [8]."""
    return parameters(117e9, 0.35, 8930.0, c2=157e6, c4=425e6)


def impact(speed: float, size: Size, row: Tensor, *, cells: int = 4, seconds: float = 80e-6) -> Bar:
    """A quarter of a bar between two planes of symmetry, on a frictionless wall.

    The end of a point's cell is its position plus its stretched half spacing.

    Args:
        speed: Of the impact [m/s].
        size: Of the bar.
        row: Of its matter, a von Mises metal, [8].
        cells: Across the radius.
        seconds: After which it is measured.
    """
    dx = size.radius / cells
    step = 0.5 * dx
    edge = size.radius + step
    points = box([0.0, 0.0, 0.0], [edge, edge, round(size.length / step) * step], step)
    points = points[points[:, :2].norm(dim=1) <= size.radius]
    start = float(points[:, 2].max()) + 0.5 * step
    volume = 0.25 * math.pi * size.radius**2 * start / points.shape[0]
    world = World(
        points, [0.0, 0.0, -speed], volume=volume, dx=dx, law=VON_MISES, params=row,
        colliders=[wall(0), wall(1), wall(2, mode="separate")],
        deformation=True, dtype=torch.float32,
    )  # fmt: skip
    world.run(seconds=seconds)
    assert world.deformation is not None
    position, stretch = world.position.double().cpu(), world.deformation.double().cpu()
    top = int(position[:, 2].argmax())
    end = float(position[top, 2] + 0.5 * step * stretch[top, 2, 2])
    distance = position[:, :2].norm(dim=1)

    def widest(where: Tensor) -> float:
        rim = int(torch.where(where, distance, 0.0).argmax())
        outward = points[rim, :2] / points[rim, :2].norm()
        return float(distance[rim] + 0.5 * step * (stretch[rim, :2, :2] @ outward).norm())

    near = (position[:, 2] - 0.2 * size.length).abs() < dx
    return Bar(end, widest(distance > 0.0), widest(near), start, points.shape[0])


@problem(tier="fast")
def taylor_bar() -> list[Result]:
    """Taylor bar: final length and foot of a copper cylinder at 227 m/s after 80 microseconds.

    32.4 mm x 6.4 mm; E 117 GPa, nu 0.35, 8930 kg/m^3, yield stress 400 MPa, linear hardening 100
    MPa.
    """
    size = Size(3.2e-3, 32.4e-3)
    bar = impact(227.0, size, parameters(117e9, 0.35, 8930.0, c2=400e6, c4=100e6))
    source = "solver.md 3 row 14: 21.4 mm, 7.0 to 7.2 mm; Wilkins and Guinan 1973"
    return [
        compare(
            "final length", bar.length * 1e3, 21.4 * bar.start / size.length, tolerance=0.03,
            unit="mm", source=source, note=f"{bar.points} points in a quarter",
        ),
        compare(
            "radius of the foot", bar.foot * 1e3, 7.1, tolerance=0.07, unit="mm", source=source
        ),
    ]  # fmt: skip


@problem(tier="fast")
def taylor_bar_annealed() -> list[Result]:
    """Taylor bar: annealed copper at 190 m/s, 25.4 mm x 7.62 mm, by two laws of its hardening."""
    source = "Johnson and Holmquist 1988: 16.2, 13.5, 10.1 mm, quoted from memory; hardening "
    rows = {
        "fitted": (fitted_copper(), "157 + 425 strain MPa, fitted to such bars"),
        "Johnson and Cook": (johnson_cook_copper(), "of Johnson and Cook 1983, from other tests"),
    }
    found = []
    for name, (row, hardening) in rows.items():
        bar = impact(190.0, ANNEALED, row)
        measures = {
            "final length": (bar.length, 16.2 * bar.start / ANNEALED.length),
            "width of the foot": (2.0 * bar.foot, 13.5),
            "width at a fifth": (2.0 * bar.bulge, 10.1),
        }
        found += [
            compare(
                f"{what}, {name}", got * 1e3, wanted, tolerance=0.05, unit="mm",
                source=source + hardening,
            )
            for what, (got, wanted) in measures.items()
        ]  # fmt: skip
    return found
