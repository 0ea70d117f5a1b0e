"""Rubber pulled by grips: the force against the closed form of its law at the stretch reached."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.lab.world.driver import place
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box
from gsfluent.materials import LAWS, Material

FREE = 3.0  # length between the grips, in edges
CELLS = 4  # along an edge


def tension(material: Material, stretch: float) -> float:
    """Force per first area of a bar whose sides are free [Pa], by principal stretches."""
    mu, kappa = (float(v) for v in material.parameters()[:2])

    def stresses(side: float) -> tuple[float, float]:
        """Kirchhoff stress along and across."""
        j = stretch * side * side
        long, wide = stretch * j ** (-1 / 3), side * j ** (-1 / 3)
        pressure = 0.5 * kappa * (j * j - 1.0)
        if material.law == "yeoh":
            x = long**2 + 2.0 * wide**2 - 3.0
            c20, c30 = float(material.yeoh_c20 or 0.0), float(material.yeoh_c30 or 0.0)
            slope = mu + 4.0 * c20 * x + 6.0 * c30 * x * x
            gap = slope * (long**2 - wide**2)
        else:
            terms = [
                (float(material.ogden_mu2 or 0.0), float(material.ogden_alpha2 or 0.0)),
                (float(material.ogden_mu3 or 0.0), float(material.ogden_alpha3 or 0.0)),
            ]
            power = float(material.ogden_alpha1 or 0.0)
            terms.append(((2.0 * mu - sum(m * a for m, a in terms)) / power, power))
            gap = sum(m * (long**a - wide**a) for m, a in terms)
        return 2.0 / 3.0 * gap + pressure, -gap / 3.0 + pressure

    low, high = 0.1, 3.0
    for _ in range(80):
        side = 0.5 * (low + high)
        low, high = (side, high) if stresses(side)[1] < 0.0 else (low, side)
    return stresses(side)[0] / stretch


def pulled(material: Material, stretch: float, crossings: float = 40.0) -> tuple[float, float]:
    """Pull a bar of an edge of one metre slowly by a grip.

    Args:
        material: Of the bar.
        stretch: Of its free length at the end.
        crossings: How often a wave at rest could run along the bar meanwhile.

    Returns:
        Force on the grip over the last tenth of the time [N], and the stretch of the middle half
        then.
    """
    dx, grip = 1.0 / CELLS, 3.0 / CELLS
    spacing = 0.5 * dx
    points = box([-grip, 0.0, 0.0], [FREE + 2.0 * grip, 1.0, 1.0], spacing)
    x = points[:, 0]
    number = torch.where(x < 0.0, 0, torch.where(x > FREE, 1, -1))
    seconds = crossings * FREE / material.wave_speed
    moved = torch.zeros(2, 3, dtype=torch.float64)
    moved[1, 0] = (stretch - 1.0) * FREE / seconds
    row = material.parameters()
    volume = torch.full_like(x, spacing**3)
    rows, sdf = ops.grip_rows(
        points, volume, number, dx=dx, about=torch.zeros(2, 3, dtype=torch.float64),
        velocity=moved, angular_velocity=torch.zeros_like(moved),
    )  # fmt: skip
    points, volume, rows, sdf = (value.to(place()) for value in (points, volume, rows, sdf))
    solver = ops.Solver(
        points, torch.zeros_like(points), volume * float(row[6]), volume, dx=dx,
        gravity=(0.0, 0.0, 0.0), law=torch.tensor([LAWS[material.law]], dtype=torch.int32),
        params=row[None].to(points), alpha=torch.zeros_like(volume), colliders=rows, sdf=sdf,
    )  # fmt: skip
    solver.advance(0.9 * seconds)
    before, since, start = solver.impulse[1, 0].item(), solver.time, solver.position.double()
    solver.advance(seconds)
    force = (solver.impulse[1, 0].item() - before) / (solver.time - since)

    def middle(now: Tensor) -> float:
        """Stretch of the middle half: slope of where points are over where they were."""
        inside = (x - 0.5 * FREE).abs() < 0.25 * FREE
        rest = x[inside] - x[inside].mean()
        return float((rest * now.cpu()[inside, 0]).sum() / (rest * rest).sum())

    # a grip gives matter an impulse against its motion when it holds it back
    return abs(force), 0.5 * (middle(start) + middle(solver.position.double()))


@problem(tier="fast")
def rubber_in_tension() -> Iterator[Result]:
    """Bars of Yeoh's and Ogden's rubber, pulled a quarter and a half longer by grips."""
    for material in (materials.rubber_band, materials.natural_rubber):
        for stretch in (1.25, 1.5):
            force, reached = pulled(material, stretch)
            yield compare(
                f"force of {material.name} pulled {stretch:g} times / closed form",
                force / tension(material, reached), 1.0, tolerance=0.02,
                source="principal stretches with free sides",
                note=f"stretch of the middle half {reached:.3f}, {CELLS} cells across",
            )  # fmt: skip
