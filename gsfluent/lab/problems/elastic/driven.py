"""Driven points: a bar pulled, a rod twisted, a beam bent by grips; reactions by closed forms."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsfluent import ops
from gsfluent.lab.problems.elastic.beams import TORSION
from gsfluent.lab.problems.elastic.statics import FACE, slope
from gsfluent.lab.world.driver import place
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters

POISSON = 0.0  # grips hinder no contraction: the closed forms are exact
FREE = 2.0  # length between the grips, in edges


def reaction(what: str, cells: int, crossings: float) -> tuple[float, int]:
    """Drive one end of a square bar slowly; how its reaction grows with the way it has gone.

    Args:
        what: ``pull``, ``twist`` or ``bend``.
        cells: Cells along the edge.
        crossings: How often a wave could run along the bar meanwhile.

    Returns:
        The reaction per way over the closed form, and the steps taken.
    """
    dx, grip, way = 1.0 / cells, 3.0 / cells, 1e-3
    spacing = 0.5 * dx
    points = box([-grip, 0.0, 0.0], [FREE + 2.0 * grip, 1.0, 1.0], spacing)
    x = points[:, 0]
    number = torch.where(x < 0.0, 0, torch.where(x > FREE, 1, -1))
    seconds = crossings * FREE  # waves run at 1 m/s
    moved, turned = (torch.zeros(2, 3, dtype=torch.float64) for _ in range(2))
    # turned about the middle of what is free, the beam feels the same moment everywhere
    about = torch.tensor([[0.0, 0.5, 0.5], [0.5 * FREE, 0.5, 0.5]], dtype=torch.float64)
    free = FREE + 2.0 * FACE * dx  # between the faces that the free part feels
    if what == "pull":
        moved[1, 0], exact, column = way / seconds, way / free, 0
    elif what == "twist":
        turned[1, 0], exact, column = way / seconds, 0.5 * TORSION * way / free, 3
    else:
        turned[1, 2], exact, column = way / seconds, way / (12.0 * free), 5
    mass = torch.full_like(x, spacing**3)
    rows, sdf = ops.grip_rows(
        points, mass, number, dx=dx, about=about, velocity=moved, angular_velocity=turned
    )
    points, mass, rows, sdf = (value.to(place()) for value in (points, mass, rows, sdf))
    solver = ops.Solver(
        points, torch.zeros_like(points), mass, mass, dx=dx, gravity=(0.0, 0.0, 0.0),
        law=torch.zeros(1, dtype=torch.int32, device=points.device),
        params=parameters(1.0, POISSON, 1.0)[None].to(points), colliders=rows, sdf=sdf,
    )  # fmt: skip
    parts, found = 40, []
    before, since = torch.zeros(6, dtype=torch.float64), 0.0
    for part in range(parts):
        solver.advance((part + 1) * seconds / parts)
        given = torch.cat([solver.impulse[1], solver.torque[1]]).cpu()
        found.append((given - before)[column] / (solver.time - since))
        before, since = given, solver.time
    share = (torch.arange(parts, dtype=torch.float64) + 0.5) / parts
    return slope(share, torch.stack(found)) / exact, solver.steps


@problem(tier="fast")
def driven_points() -> Iterator[Result]:
    """A square bar of 6 cells held at one end, pulled, twisted, bent at the other: reactions."""
    cases = (
        ("pull", "force of a bar pulled", 20.0, "E A / L"),
        ("twist", "moment of a rod twisted", 30.0, "Saint-Venant, G J / L"),
        ("bend", "moment of a beam bent", 120.0, "Euler-Bernoulli, E I / L"),
    )
    for what, name, crossings, source in cases:
        got, steps = reaction(what, 6, crossings)
        yield compare(
            f"{name} / closed form, 6 cells", got, 1.0, tolerance=0.01, source=source,
            note=f"L between the faces that are felt, {FACE:.3f} dx into the grips; {steps} steps",
        )  # fmt: skip
