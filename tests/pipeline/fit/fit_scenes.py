"""Small scenes that are fitted to: a cube or a ball of an elastic thing falls on the floor."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import SURFACE, Gaussians, Solid
from gsfluent.materials import Material
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.scene.parts import Part
from gsfluent.scene.scene import Scene
from gsfluent.targets import Points
from gsfluent.targets.target import Followers

SIDE = 0.32


def solid(shape: str = "cube", voxels: int = 32, side: float = SIDE) -> Solid:
    """A cube or a ball with its lower side at z = 0, with splats on its skin."""
    h = side / voxels
    axis = (torch.arange(voxels) + 0.5) * h - 0.5 * side
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    full = torch.ones(voxels, voxels, voxels, dtype=torch.bool)
    if shape == "ball":
        full = grid.norm(dim=-1) < 0.5 * side
    edge = full.clone()
    edge[1:-1, 1:-1, 1:-1] &= ~(
        full[2:, 1:-1, 1:-1] & full[:-2, 1:-1, 1:-1] & full[1:-1, 2:, 1:-1]
        & full[1:-1, :-2, 1:-1] & full[1:-1, 1:-1, 2:] & full[1:-1, 1:-1, :-2]
    )  # fmt: skip
    lift = torch.tensor([0.0, 0.0, 0.5 * side])
    skin = grid[edge] + lift
    splats = Gaussians.from_colors(
        skin, torch.full((len(skin),), 0.6 * h), torch.full((len(skin), 3), 0.5), label=SURFACE
    )
    origin = torch.full((3,), -0.5 * side) + lift
    return Solid(splats, full, torch.zeros_like(full, dtype=torch.float32), origin, h)


def scene(
    material: Material, *, shape: str = "cube", velocity: Any = (0.0, 0.0, -2.0), gap: float = 0.06
) -> Scene:
    """It flies at ``gap`` over the floor at time 0."""
    made = Scene()
    made.add(solid(shape), material, velocity=velocity, name="thing")
    made.lift(gap)
    return made


def elastic(young: float = 1e5, nu: float = 0.3, **more: Any) -> Material:
    return Material("rubber", young, nu, 1000.0, law="elastic", **more)


def seen(
    truth: Scene, dx: float, frames: int = 10, fps: float = 24.0, count: int = 120
) -> tuple[NDArray[np.float64], Forward]:
    """Tracks [T, K, 3] of places inside, from a run of the true scene."""
    forward = Forward(truth, [k / fps for k in range(frames)], dx)
    motion = forward.run({}, frames, forward.step({}))
    rows = np.random.default_rng(3).choice(forward.count, count, replace=False)
    follow = Followers("test", forward.rest[torch.from_numpy(rows)], forward.setting())
    return np.stack([follow.places(motion, k)[0].numpy() for k in range(frames)]), forward


__all__ = ["SIDE", "Points", "elastic", "scene", "seen", "solid"]


def halves(below: dict[str, Any], material: Material) -> Any:
    """The cube, whose lower half is another thing."""
    made = scene(material, velocity=(0.0, 0.0, -2.0))
    part = Part("low", {"box": [[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5 * SIDE]]}, below)
    made.bodies[0] = dataclasses.replace(made.bodies[0], parts=(part,))
    return made
