"""Balls on a floor over twenty thousand steps, and melons dropped on three grids."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.fracturebench.scenes.shatter import lattice_ball
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.walls import wall
from gsfluent.materials import phase_field
from gsfluent.materials.laws import LAWS
from gsfluent.ops.plasticity import weakened
from gsfluent.pipeline.simulate.stage import Simulate

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fracture_resolution import MELON, Trial

STEPS, LOOKS = 20_000, 100
SOLID = (1e6, 0.25, 1000.0)
GRAVITY = 9.81
MELON_LENGTH = 0.025
"""Of the phase field, two cells of the coarsest grid [m]."""
SPLIT = 0.04
"""After the landing [s]: it has split, and its pieces have not yet met anything."""


@dataclasses.dataclass(frozen=True)
class Throw:
    """A ball that meets a floor.

    Attributes:
        speed: Over the wave speed.
        strength: In tension [Pa].
        gravity: [m/s^2].
    """

    speed: float
    strength: float
    gravity: float


@dataclasses.dataclass(frozen=True)
class Fruit(Trial):
    """A melon of a matter of its own."""

    ware: materials.Material | None = None

    @property
    def matter(self) -> materials.Material:
        """What it is made of."""
        return self.ware or super().matter


THROWS = {"shatter": Throw(0.25, 4e4, 0.0), "ball": Throw(0.08, 2e4, GRAVITY)}


def _world(throw: Throw, cells: int, order: Tensor | None, device: str) -> World:
    """The ball before it lands, its points in an order."""
    radius = 0.1
    dx = radius / cells
    points = torch.from_numpy(lattice_ball(radius, dx, 8))
    points = points if order is None else points[order]
    young, poisson, density = SOLID
    ware = materials.Material(
        "ball", law="phase_field", young_modulus=young, poisson_ratio=poisson, density=density,
        toughness=1.0, tensile_strength=throw.strength, prefer="strength",
    )  # fmt: skip

    def at(value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64).reshape(1)

    row = phase_field.rows(ware, at, torch.ones(1, dtype=torch.float64), dx)
    return World(
        points, (0.0, 0.0, -throw.speed * ware.wave_speed), volume=dx**3 / 8.0, dx=dx,
        law=LAWS["phase_field"], params=row, alpha=torch.full((len(points),), -1.0),
        gravity=(0.0, 0.0, -throw.gravity), colliders=[wall(2, -radius, mode="separate")],
        dtype=torch.float32, device=device,
    )  # fmt: skip


def _energy(world: World, gravity: float) -> float:
    """Kinetic, elastic and gravity's [J]."""
    scene = world.scene
    law, params = weakened(scene.law, scene.params.double(), scene.material, world.peak.double())
    stored = ops.elastic_energy(world.strain.double(), law=law, params=params)
    held = float((stored * scene.volume.double()).sum())
    height = world.position.double()[:, 2]
    return world.kinetic() + held + gravity * float((scene.mass.double() * height).sum())


def floor(name: str, cells: int, device: str) -> tuple[dict[str, Any], None, None]:
    """Momentum, energy and bits of a ball over :data:`STEPS` steps.

    Args:
        name: Of :data:`THROWS`.
        cells: In a radius.
        device: Where. On the CPU the second run has two threads, on either its points another
            order.
    """
    throw = THROWS[name]
    world = _world(throw, cells, None, device)
    count = world.position.shape[0]
    order = torch.randperm(count, generator=torch.Generator().manual_seed(5))
    other = _world(throw, cells, order, device)
    mass = float(world.scene.mass.double().sum())
    begin, top = world.momentum(), mass * throw.speed * math.sqrt(SOLID[0] / SOLID[2])
    first = last = _energy(world, throw.gravity)
    gained = off = 0.0
    weight = begin.new_tensor([0.0, 0.0, -mass * throw.gravity])
    threads = torch.get_num_threads()
    same = True
    for _ in range(LOOKS):
        world.run(steps=STEPS // LOOKS)
        if device == "cpu":
            torch.set_num_threads(2)
        other.run(steps=STEPS // LOOKS)
        torch.set_num_threads(threads)
        now = _energy(world, throw.gravity)
        gained, last = max(gained, (now - last) / abs(first)), now
        left = world.momentum() - begin - world.impulse.sum(dim=0).to(begin) - weight * world.time
        off = max(off, float(left.abs().max()) / top)
        same = same and torch.equal(world.position[order.to(world.position.device)], other.position)
    return {
        "name": name, "points": count, "steps": world.steps, "dx": world.scene.dx,
        "broken": float((world.peak >= 0).double().mean()), "momentum": off, "gained": gained,
        "kept": last / first, "same": same,
    }, None, None  # fmt: skip


def melon(cells: int, seed: int, height: float, device: str) -> tuple[dict[str, Any], None, None]:
    """Pieces of a melon that falls on a floor, with cracks of one width on every grid.

    Args:
        cells: Along it.
        seed: Of its points and where it is weak.
        height: It falls from [m].
        device: Where.
    """
    fruit = materials.get("fruit.watermelon")
    ware = fruit.override(
        law="phase_field", length=MELON_LENGTH, prefer="strength", split="rankine"
    )
    given = {field.name: getattr(MELON, field.name) for field in dataclasses.fields(MELON)}
    trial = Fruit(**{**given, "height": 1e-3}, ware=ware)
    scene = trial.scene()
    scene.throw((0.0, 0.0, -math.sqrt(2.0 * GRAVITY * height)))  # the end of its fall
    dx = 2.0 * max(trial.half) / cells
    sim = Simulate(dx=dx, seed=seed, repair=False, splats=False, device=device)
    steps = sim(scene, fps=1.0 / SPLIT, seconds=trial.seconds + 0.5 * SPLIT)
    looks = []
    for frame in steps:
        shares = frame.pieces.mass_fractions
        looks.append({
            "pieces": int((shares > 0.03).sum()),
            "largest": float(shares[0]) if len(shares) else 0.0,
            "broken": float(frame.broken.double().mean()),
        })  # fmt: skip
    return {
        "cells": cells, "seed": seed, "height": height, "split": ware.split,
        "points": frame.particles.count, "dx": dx, "steps": steps.report["substeps"],
        "first": looks[1], **looks[-1], "verdict": steps.report["verdict"],
    }, None, None  # fmt: skip
