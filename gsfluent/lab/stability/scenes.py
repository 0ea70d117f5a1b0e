"""The small scenes of the stability maps, and how a run of one becomes an outcome."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsfluent.lab.stability.maps import Outcome, Place
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.invariants import Limits, OfWorld, Violation, first_violation
from gsfluent.lab.world.resident import Resident
from gsfluent.lab.world.shapes import ball, box, nacc, parameters, wave_speed
from gsfluent.lab.world.walls import wall

DX = 0.1
DENSITY = 1000.0
YOUNG = 1e5
FLOOR = wall(2, mode="separate")[None]
SHIFT = torch.tensor([0.37, 0.21, 0.11], dtype=torch.float64) * DX
"""Lattices do not start on nodes: that would be the easy case."""


def noise(count: int, seed: int = 0) -> Tensor:
    """Random velocities of variance one, float64 [N, 3], the same on every machine."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, 3, dtype=torch.float64, generator=generator)


def block(cells: float = 3.0, per_cell: int = 8) -> tuple[Tensor, float]:
    """Points of a cube and the volume of each."""
    spacing = DX / round(per_cell ** (1.0 / 3.0))
    return box([0.0] * 3, [cells * DX] * 3, spacing) + SHIFT, spacing**3


def clusters(size: int, count: int = 64) -> tuple[Tensor, float]:
    """Clusters of ``size`` points within a cell, twelve cells apart, and the volume of a point."""
    generator = torch.Generator().manual_seed(3)
    side = math.ceil(count ** (1.0 / 3.0))
    places = [
        torch.rand(size, 3, dtype=torch.float64, generator=generator) * 0.8 * DX
        + 12.0 * DX * torch.tensor([i % side, i // side % side, i // side**2]).double()
        for i in range(count)
    ]
    return torch.cat(places), DX**3 / 8.0


class Courant:
    """A Courant number, of any size, of the solver's automatic step."""

    def __init__(self, number: float) -> None:
        self.cfl = min(number, 1.0)
        self.scale = number / self.cfl

    def apply(self, world: World) -> World:
        """Stretch the steps of a world that was made with ``cfl=self.cfl``."""
        assert isinstance(world.stepper, Resident)
        world.stepper.solver.dt_scale = self.scale
        return world


def thrown(
    speed: float,
    *,
    young: float = YOUNG,
    courant: float | None = None,
    dt: float | None = None,
    place: Place,
    **options: Any,
) -> World:
    """A ball that starts on a frictionless floor with a speed [m/s] towards it."""
    row = parameters(young, 0.3, DENSITY)
    points = ball([0.013, -0.021, 2.0 * DX + 0.1 * DX], 2.0 * DX, 0.5 * DX)
    stretch = Courant(0.5 if courant is None else courant)
    volume = (0.5 * DX) ** 3
    world = World(
        points, [0.0, 0.0, -speed], volume=volume, dx=DX, law=0, params=row, colliders=FLOOR,
        cfl=stretch.cfl, dt=dt, dtype=torch.float32, device=place.device, **options,
    )  # fmt: skip
    return stretch.apply(world) if dt is None and world.engine == "solver" else world


SPACING = 1.0 / 32.0
BRITTLE = {
    "young_modulus": 166.0, "poisson_ratio": 0.38, "density": 1.0, "friction": 1.85,
    "cohesion": 0.6,
}  # fmt: skip
STRENGTH = 0.12
"""xi alpha of the intact ball: sinh of it is the strength over the bulk modulus."""
IMPACT = 0.34


def brittle(
    *,
    hardening: float = 3.0,
    courant: float = 0.3,
    mach: float = IMPACT,
    order: int | None = None,
    place: Place,
    **options: Any,
) -> World:
    """A NACC ball that breaks on a floor (equations.md, the drop of row 8), (c + v) dt / dx fixed.

    ``order`` is the seed of another numbering of its points.
    """
    row = nacc(
        BRITTLE["young_modulus"], BRITTLE["poisson_ratio"], BRITTLE["density"],
        friction=BRITTLE["friction"], cohesion=BRITTLE["cohesion"], hardening=hardening,
    )  # fmt: skip
    points, height, c = brittle_points(), 3.0 * SPACING, wave_speed(row)
    if order is not None:
        points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(order))]
    volume = (0.5 * SPACING) ** 3
    floor = wall(2, height, mode="separate", friction=0.3)[None]
    return World(
        points, [0.0, 0.0, -mach * c], volume=volume, dx=SPACING, law=1, params=row,
        alpha=torch.full((len(points),), -STRENGTH / hardening), colliders=floor,
        gravity=(0.0, 0.0, -9.81), dt=courant * SPACING / (c * (1.0 + mach)), dtype=torch.float32,
        device=place.device, **options,
    )  # fmt: skip


def brittle_points() -> Tensor:
    """Points of the brittle ball, a quarter of a cell above the floor."""
    return ball([0.5, 0.5, 3.25 * SPACING + 0.08], 0.08, 0.5 * SPACING)


def watched(
    world: World,
    steps: int,
    place: Place,
    *,
    limits: Limits | None = None,
    group: Tensor | None = None,
) -> Outcome:
    """Run a world under watch."""
    moving = OfWorld(world, group)
    found = first_violation(moving, steps, limits=limits, every=place.every)
    return Outcome(steps, found, len(world.scene.mass))


def refused(steps: int, error: Exception) -> Outcome:
    """The outcome of a scene that the solver does not take in the first place."""
    why = str(error).splitlines()[0]
    return Outcome(steps, Violation(0, "stopped", math.inf, 0.0, why), 0)
