"""A column let go in a tank: water ends level, sand on a slope, metal and rock stand."""

from __future__ import annotations

import functools

import pytest
import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.lab.world.driver import World
from gsfluent.materials import LAWS, Material
from gsfluent.ops import collider_row

DX, WIDTH, DEPTH = 0.02, 8, 2
COLUMN = (4, DEPTH, 6)  # cells; spread over the tank it is three cells high


def walls() -> Tensor:
    faces = [((0, 0, 0), (0, 0, 1)), ((0, 0, 0), (1, 0, 0)), ((WIDTH * DX, 0, 0), (-1, 0, 0))]
    faces += [((0, 0, 0), (0, 1, 0)), ((0, DEPTH * DX, 0), (0, -1, 0))]
    return torch.stack(
        [collider_row("plane", point=p, normal=n, mode="slip" if i else "separate", friction=0.5)
         for i, (p, n) in enumerate(faces)]
    )  # fmt: skip


@functools.cache
def collapsed(name: str) -> tuple[Tensor, World]:
    """Positions [dx] after 3 s of a liquid or 1 s of a solid, and the world."""
    material: Material = materials.get(name)
    if material.law == "fluid":  # the flow is slow here, so its sound may be
        material = material.override(bulk_modulus=64.0 * float(material.density or 0.0))
    axes = [(torch.arange(2 * n, dtype=torch.float64) + 0.5) * 0.5 * DX for n in COLUMN]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    row = material.parameters()
    world = World(
        points,
        (0.0, 0.0, 0.0),
        mass=float(row[6]) * DX**3 / 8.0,
        volume=DX**3 / 8.0,
        dx=DX,
        law=LAWS[material.law],
        params=row,
        alpha=torch.full((len(points),), float(material.start_alpha)),
        gravity=(0.0, 0.0, -9.81),
        colliders=walls(),
        dtype=torch.float32,
    )
    world.run(seconds=3.0 if material.law == "fluid" else 1.0)
    return world.position.double() / DX, world


def surface(position: Tensor) -> Tensor:
    """Height [dx] of the highest point of each fourth of the tank, left to right."""
    quarter = (position[:, 0] / (WIDTH / 4.0)).long().clamp(0, 3)
    return torch.stack([position[quarter == i, 2].max() for i in range(4)])


def test_water_ends_level_and_keeps_its_volume() -> None:
    position, world = collapsed("water")
    heights = surface(position)
    assert float(heights.max() - heights.min()) < 0.5
    assert float(position[:, 2].mean()) == pytest.approx(1.5, rel=0.08)  # half of three cells
    assert float(world.velocity.norm(dim=1).max()) < 0.02


def test_sand_stays_on_a_slope_and_rests() -> None:
    position, world = collapsed("sand")
    heights = surface(position)
    assert float(heights[0] - heights[-1]) > 1.0
    assert float(world.velocity.norm(dim=1).max()) < 0.02


@pytest.mark.parametrize("name", ["plasticine", "jelly"])
def test_what_carries_its_weight_stands(name: str) -> None:
    position, _ = collapsed(name)
    assert float(position[:, 2].max()) > 5.0
    assert float(position[:, 0].max()) < 5.0
