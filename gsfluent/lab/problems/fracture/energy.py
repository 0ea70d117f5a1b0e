"""Fracture energy that is asked for against what a crack takes, with the automatic crack band.

A bar pulled apart, a pair of cantilevers opened slowly and a notched beam bent between three
rollers. The material is what handbooks give, strengths and G_c;
:func:`gsfluent.pipeline.matter.brittle.brittle_rows` makes it NACC of the grid, as a simulation
does.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.lab.problems.fracture.dissipation import Dissipation
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters, sheet, wave_speed
from gsfluent.lab.world.walls import between_planes
from gsfluent.materials import Material
from gsfluent.pipeline.matter.brittle import brittle_rows

YOUNG, POISSON, DENSITY = 1e9, 0.2, 1000.0
TENSILE, COMPRESSIVE = 4e6, 4e7
HEAVY = 100.0
"""Factor on the mass of what is held: a step's forces move it before its velocity is set again, so
that light grips slip by ``sigma dt / (rho width)``, some 1e-3 c."""


def stone(length: float) -> Material:
    """A brittle material of which ``E G_c / s^2``, s its tensile strength, is a length [m]."""
    return Material(
        "stone", young_modulus=YOUNG, poisson_ratio=POISSON, density=DENSITY, friction_angle=50.0,
        tensile_strength=TENSILE, compressive_strength=COMPRESSIVE,
        fracture_energy=length * TENSILE**2 / YOUNG, shear_damage=0.0,
    )  # fmt: skip


def rows_of(material: Material, weakness: Tensor, dx: float) -> tuple[Tensor, Tensor, Tensor]:
    """Rows [M, 8], the row of each point int32 [N] and its alpha0 [N] on a grid.

    Args:
        material: Given by strengths and fracture energy.
        weakness: Factor on the strength of each point, [N].
        dx: Node spacing [m].
    """

    def everywhere(value: float | Tensor) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64).expand(weakness.shape[0])

    rows, alpha = brittle_rows(material, everywhere, weakness, dx)
    table, which = torch.unique(rows, dim=0, return_inverse=True)
    return table, which.int(), alpha


@dataclasses.dataclass(frozen=True)
class Crack:
    """What a crack took: energy per area over G_c, and where its tip is [m]."""

    energy: float
    tip: float
    band: float  # broken cells across it


def pull_apart(cells: int, *, length: float = 0.6, pull: float = 1.5e-3, shift: float = 0.0) -> Crack:
    """Pull a bar of one metre apart, in uniaxial strain, a fifth weaker in the middle.

    Args:
        cells: Along the bar.
        length: ``E G_c / s^2`` [m].
        pull: Speed of each grip over that of a pressure wave.
        shift: Position of the bar relative to the nodes [dx].
    """
    dx = 1.0 / cells
    material = stone(length)
    points = box([0.0, 0.0, 0.0], [1.0, dx, dx], 0.5 * dx)
    away = points[:, 0] - 0.5
    weakness = 1.0 - 0.2 * torch.exp(-((away / 0.1) ** 2))
    weakness[away.abs() > 0.3] = 1.5  # what is held must not break
    table, which, alpha = rows_of(material, weakness, dx)
    c = wave_speed(table[0])
    velocity = torch.zeros_like(points)
    velocity[:, 0] = 2.0 * pull * c * away
    held = away.abs() > 0.48 - 2.0 * dx

    def grip(world: World, _dt: float) -> None:
        v, affine = world.velocity.clone(), world.affine.clone()
        v[held, 0] = (pull * c * away[held].sign()).to(v)
        affine[held] = 0.0
        world.velocity, world.affine = v, affine

    offset = torch.tensor([shift * dx, 0.0, 0.0], dtype=torch.float64)
    volume = (0.5 * dx) ** 3
    mass = torch.where(held, HEAVY * DENSITY * volume, DENSITY * volume)
    world = World(
        points + offset, velocity, volume=volume, mass=mass, dx=dx, law=torch.ones(len(table)),
        params=table, material=which, alpha=alpha, colliders=between_planes(dx, (1, 2)),
        force=grip,
    )  # fmt: skip
    meter = Dissipation(world)
    world.run(seconds=0.0075 / pull / c, each=meter)
    broken = (world.peak >= 0.0) & (away.abs() < 0.3)
    energy = float(meter.of_points()[away.abs() < 0.3].sum()) / (dx * dx)
    return Crack(energy / float(material.fracture_energy), 0.0, float(broken.sum()) / 8.0)


def open_slowly(
    cells: int,
    *,
    length: float = 0.3,
    speed: float = 1e-3,
    shift: float = 0.0,
    crossings: float = 14.0,
) -> Crack:
    """Wedge the arms of a notched slab apart, so that a crack runs between them.

    One metre long, 0.375 m high, notch of 0.25 m; a layer of an eighth of a metre around the middle
    can break. Energy is taken where the crack has passed, between 0.3125 and 0.5 m.

    Args:
        cells: Per metre.
        length: ``E G_c / s^2`` [m].
        speed: Of each arm over that of a pressure wave, after a ramp of one crossing.
        shift: Position of the slab relative to the nodes [dx].
        crossings: Duration in travel times of a pressure wave along the slab.
    """
    dx, height, notch = 1.0 / cells, 0.375, 0.25
    material = stone(length)
    points = sheet([0.0, 0.0], [1.0, height], dx)
    middle = points[:, 1] - 0.5 * height
    keep = (points[:, 0] > notch) | (middle.abs() > 1.01 * dx)
    points, middle = points[keep], middle[keep]
    x = points[:, 0]
    layer = middle.abs() < 0.0625
    ends = (x < 0.0626) & (middle.abs() > 0.5 * height - 0.0626)
    table, _, alpha = rows_of(material, torch.ones_like(x), dx)
    c = wave_speed(table[0])
    opening = speed * c * middle[ends].sign().to(torch.float32)

    def wedge(world: World, _dt: float) -> None:
        v = world.velocity.clone()
        v[ends, 1] = min(1.0, world.time * c) * opening.to(v)
        world.velocity = v

    volume = 0.25 * dx**3
    mass = torch.where(ends, HEAVY * DENSITY * volume, DENSITY * volume)
    world = World(
        points + torch.tensor([0.0, shift * dx, 0.0], dtype=torch.float64), [0.0, 0.0, 0.0],
        volume=volume, mass=mass, dx=dx, law=torch.tensor([0, 1]),
        params=torch.stack([parameters(YOUNG, POISSON, DENSITY), table[0]]),
        material=layer.int(), alpha=alpha, colliders=between_planes(dx), dtype=torch.float32,
        force=wedge,
    )  # fmt: skip
    meter = Dissipation(world)
    world.run(seconds=crossings / c, each=meter)
    low, high = notch + 0.0625, 0.5
    passed = layer & (x > low) & (x < high)
    broken = layer & (world.peak >= 0.0).cpu()
    tip = float(x[broken].max()) if bool(broken.any()) else notch
    energy = float(meter.of_points()[passed].sum()) / (dx * (high - low))
    across = float((broken & passed).sum()) / 4.0 * dx / (high - low)
    return Crack(energy / float(material.fracture_energy), tip, across)
