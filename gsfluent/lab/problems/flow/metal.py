"""Taylor bars: copper cylinders that hit a rigid wall."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsfluent.lab.problems.flow.elements import Bar as Elements
from gsfluent.lab.problems.flow.elements import Metal, Numbers
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


def johnson_cook_flow(strain: Numbers, rate: Numbers, work: Numbers) -> Numbers:
    """Yield stress of the same [Pa], with the heat of the work [J/m^3] as a temperature."""
    hard = 90e6 + 292e6 * np.maximum(strain, 1e-12) ** 0.31
    heat = 8960.0 * 383.0 * (1356.0 - 298.0) / 0.9
    fast: Numbers = 1.0 + 0.025 * np.log(np.maximum(rate, 1.0))
    return hard * fast * np.maximum(1.0 - work / heat, 0.0)


def fitted_flow(strain: Numbers, rate: Numbers, work: Numbers) -> Numbers:
    """Yield stress of :func:`fitted_copper` [Pa]."""
    return 157e6 + 425e6 * strain


def fitted_copper() -> Tensor:
    """The same metal by a linear hardening that was fitted to its bars, [8]."""
    return parameters(117e9, 0.35, 8930.0, c2=157e6, c4=425e6)


def impact(speed: float, size: Size, row: Tensor, *, cells: int = 4, seconds: float = 80e-6) -> Bar:
    """A quarter of a bar between two planes of symmetry, on a frictionless wall.

    A face is where the nearest points and their stretch put it; widths are means round the bar.

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
    outward = torch.zeros_like(points)
    far = points[:, :2].norm(dim=1, keepdim=True)
    outward[:, :2] = points[:, :2] / far
    # where the side of the bar is beside its outermost points: the lattice ends short of it
    side = position + (stretch @ (outward * (size.radius - far))[:, :, None])[:, :, 0]
    rim = far[:, 0] > size.radius - step
    lowest = rim & (points[:, 2] < step)
    foot = side[lowest] - 0.5 * step * stretch[lowest, :, 2]
    near = rim & ((side[:, 2] - 0.2 * size.length).abs() < 2.0 * dx)
    height, width = side[near, 2] - 0.2 * size.length, side[near, :2].norm(dim=1)
    line = torch.stack([torch.ones_like(height), height, height**2], dim=1)
    bulge = torch.linalg.lstsq(line, width[:, None]).solution[0]
    return Bar(end, float(foot[:, :2].norm(dim=1).mean()), float(bulge), start, points.shape[0])


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


RECOVERED = {  # speed [m/s]: final length, width at a fifth [mm]
    130.0: (19.558, 8.92),
    146.0: (18.694, 9.30),
    190.0: (16.205, 10.10),
}
FOOT = 13.564  # width of the foot at 190 m/s [mm]
SOURCE = (
    "Johnson and Cook 1983 (130, 146 m/s), Zerilli and Armstrong 1987 (190 m/s), digitized by "
    "Banerjee, github.com/bbanerjee/HighRateExptData"
)


@problem(tier="fast")
def taylor_bar_annealed() -> Iterator[Result]:
    """Taylor bars recovered: annealed copper, 25.4 mm x 7.62 mm, by a hardening fitted to such."""
    for speed, (length, width) in RECOVERED.items():
        bar = impact(speed, ANNEALED, fitted_copper())
        measures = {
            "final length": (bar.length, length * bar.start / ANNEALED.length),
            "width at a fifth": (2.0 * bar.bulge, width),
        }
        if speed == 190.0:
            measures["width of the foot"] = 2.0 * bar.foot, FOOT
        for what, (got, wanted) in measures.items():
            yield compare(
                f"{what}, {speed:g} m/s", got * 1e3, wanted, tolerance=0.05, unit="mm",
                source=SOURCE, note="157 + 425 strain MPa; 4 cells a radius",
            )  # fmt: skip


@problem(tier="slow")
def taylor_bar_elements() -> Iterator[Result]:
    """Taylor bar of annealed copper at 190 m/s beside finite elements, by two laws."""
    laws = {
        "fitted": (fitted_copper(), Metal(117e9, 0.35, 8930.0, fitted_flow)),
        "Johnson and Cook": (johnson_cook_copper(), Metal(124e9, 0.34, 8960.0, johnson_cook_flow)),
    }
    for name, (row, metal) in laws.items():
        elements = Elements(metal, ANNEALED.radius, ANNEALED.length, 190.0)
        elements.run(80e-6)
        length, foot, bulge = elements.measures()
        coarse, bar = (impact(190.0, ANNEALED, row, cells=cells) for cells in (4, 6))
        scale = ANNEALED.length / coarse.start
        for what, got, rough, wanted in (
            ("final length", bar.length, scale * coarse.length, length),
            ("width of the foot", 2.0 * bar.foot, 2.0 * coarse.foot, 2.0 * foot),
            ("width at a fifth", 2.0 * bar.bulge, 2.0 * coarse.bulge, 2.0 * bulge),
        ):
            yield compare(
                f"{what}, {name}, 6 cells", got * 1e3, wanted * 1e3, tolerance=0.05, unit="mm",
                source="finite elements of the same law, 8 across the radius, float64",
                note=f"4 cells {rough * 1e3:.3f} mm",
            )  # fmt: skip
