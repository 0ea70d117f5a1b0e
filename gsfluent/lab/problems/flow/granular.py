"""Sand: collapse of a column between two walls, and how far it runs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import parameters, sheet
from gsfluent.lab.world.walls import between_planes, wall

DRUCKER_PRAGER = 2
FRICTION_ANGLE = 26.0
"""Of the triaxial fit [degrees]; in plane strain that is sin(phi) = M / sqrt(3), 36 degrees. The
one number here that was chosen (to the three run-outs together); Lube et al. found no dependence on
the grains."""


def run_out(aspect: float, cells: int = 16) -> float:
    """Run-out of a column of base 1 m beside a wall, over its base."""
    dx = 1.0 / cells
    sine = math.sin(math.radians(FRICTION_ANGLE))
    alpha_dp = math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
    points = sheet([0.0, 0.0], [1.0, aspect], dx)
    volume, density = 0.25 * dx**3, 2000.0
    world = World(
        points, [0.0, 0.0, 0.0], volume=volume, dx=dx, law=DRUCKER_PRAGER,
        params=parameters(2e6, 0.3, density, c2=alpha_dp), 
        colliders=[*between_planes(dx), wall(0), wall(1, mode="sticky")],
        gravity=(0.0, -9.81, 0.0), dtype=torch.float32,
    )  # fmt: skip
    world.run(seconds=4.4 * math.sqrt(aspect / 9.81))
    return float(world.position[:, 0].max()) - 1.0


def law(aspect: float) -> float:
    """Run-out over base of a plane column (Lube et al. 2005): linear, then the power 2/3."""
    return 1.2 * aspect if aspect < 2.3 else 1.9 * aspect ** (2.0 / 3.0)


@problem(tier="slow")
def sand_column(aspects: Sequence[float] = (1.0, 2.0, 4.0), cells: int = 16) -> list[Result]:
    """Sand column: run-out of a plane column follows 1.2 a, then 1.9 a^(2/3)."""
    return [
        compare(
            f"run-out over base, aspect {a:g}", run_out(a, cells), law(a), tolerance=0.15,
            source="Lube et al. 2005, Phys. Rev. E 72, 041301",
            note="friction angle fitted to all aspects together",
        )
        for a in aspects
    ]  # fmt: skip
