"""Fragment size: a bar that stretches evenly breaks into shorter pieces the faster it stretches."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import torch

from gsfluent.lab.problems.fracture.spall import spall_strength
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, nacc, wave_speed
from gsfluent.lab.world.walls import between_planes
from gsfluent.pipeline.matter.crack_band import fracture_energy

YOUNG, POISSON, DENSITY = 1e9, 0.2, 1000.0
ALPHA0, CELLS = -0.004, 240
ROW = nacc(
    YOUNG, POISSON, DENSITY, friction=2.0, cohesion=0.1, hardening=math.asinh(0.01) / -ALPHA0
)  # fmt: skip
WIDE = 1.28
"""Measured energy of a crack over that of a band of two cells (problem ``softening_bar``)."""


def expected_size(rate: float) -> float:
    """Length in which stored and local kinetic energy pay for one crack [m].

    ``rho rate^2 s^3 / 24 + sigma^2 s / (2 M) = G`` (Glenn and Chudnovsky 1986; without the stored
    energy it is Grady's ``(24 G / (rho rate^2))^(1/3)``), solved by bisection.
    """
    energy = WIDE * fracture_energy(ROW, ALPHA0, dx=1.0 / CELLS)
    stored = spall_strength(ROW, ALPHA0) ** 2 / (2.0 * DENSITY * wave_speed(ROW) ** 2)
    low, high = 0.0, energy / stored
    for _ in range(60):
        middle = 0.5 * (low + high)
        paid = DENSITY * rate**2 * middle**3 / 24.0 + stored * middle
        low, high = (middle, high) if paid < energy else (low, middle)
    return 0.5 * (low + high)


def mean_size(rate: float, seed: int = 0) -> float:
    """Mean piece of a free bar of one metre whose strength scatters by a tenth [m]."""
    dx, c = 1.0 / CELLS, wave_speed(ROW)
    points = box([0.0, 0.0, 0.0], [1.0, dx, dx], 0.5 * dx)
    cell = (points[:, 0] / dx).long()
    generator = torch.Generator().manual_seed(seed)
    strength = 1.0 + 0.1 * (2.0 * torch.rand(CELLS, generator=generator, dtype=torch.float64) - 1.0)
    velocity = torch.zeros_like(points)
    velocity[:, 0] = rate * (points[:, 0] - 0.5)
    affine = torch.zeros(len(points), 3, 3, dtype=torch.float64)
    affine[:, 0, 0] = rate
    volume = (0.5 * dx) ** 3
    world = World(
        points, velocity, volume=volume, dx=dx, law=1, params=ROW, alpha=ALPHA0 * strength[cell],
        colliders=between_planes(dx, (1, 2)), affine=affine, dtype=torch.float32,
    )  # fmt: skip
    limit = spall_strength(ROW, ALPHA0) / (DENSITY * c * c)
    # to the elastic limit, and on until waves have crossed the longest pieces
    world.run(seconds=1.2 * limit / rate + 1.2 / c * min(1.0, 0.01 * c / rate))
    broken = torch.zeros(CELLS, dtype=torch.bool)
    broken[cell[(world.peak >= 0.0).cpu()]] = True
    places = broken.nonzero()[:, 0]
    cracks = 1 + int((places.diff() > 1).sum()) if len(places) else 0
    return 1.0 / (cracks + 1)


@problem(tier="slow")
def fragment_size(shares: Sequence[float] = (0.005, 0.01, 0.02, 0.05)) -> Iterator[Result]:
    """Fragment size against the rate: within a factor of two of the energy balance.

    A trend, not a law: strength scatters, and cracks that start at the same time do not share their
    energy evenly.
    """
    source = "Glenn and Chudnovsky 1986; solver.md 3 row 24"
    sizes = []
    for share in shares:
        rate = share * wave_speed(ROW)
        size = sum(mean_size(rate, seed) for seed in (0, 1)) / 2.0
        expected = expected_size(rate)
        sizes.append(size)
        yield compare(
            f"mean piece at {share:g} c per metre", size, expected,
            error=abs(math.log(size / expected)), tolerance=math.log(2.0), unit="m",
            source=source, note="error and tolerance are logarithms of the ratio",
        )  # fmt: skip
    rises = sum(b > a for a, b in itertools.pairwise(sizes))
    yield compare("rates at which faster made larger pieces", rises, tolerance=0.0, source=source)
