"""How gsfluent answers what the fracture scenes of FractureBench add: drives, damage, stresses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.driver import Force, World

__all__ = ["damage", "drive"]


class _Drive:
    """One drive on a device (keys: :class:`gsfluent.fracturebench.scene.Scene`)."""

    def __init__(
        self, scene: Scene, item: Mapping[str, Any], dtype: torch.dtype, device: torch.device
    ):
        points = item["points"]
        self.rows: Tensor | slice = (
            slice(None) if points == "all" else torch.tensor(points, dtype=torch.int64).to(device)
        )
        self.start, self.end = float(item.get("start", 0.0)), float(item.get("end", math.inf))
        self.ramp = float(item.get("ramp", 0.0))
        self.damping = float(item.get("damping", 0.0))
        self.axes: list[int] = []
        self.velocity = self.push = torch.zeros(0, dtype=dtype, device=device)
        if "velocity" in item:
            self.axes = [i for i, v in enumerate(item["velocity"]) if v is not None]
            wanted = [float(item["velocity"][i]) for i in self.axes]
            self.velocity = torch.tensor(wanted, dtype=dtype, device=device)
        if "force" in item:
            mass = torch.from_numpy(scene.mass)[self.rows if points == "all" else points]
            force = torch.tensor(item["force"], dtype=torch.float64)
            self.push = (force / mass[:, None]).to(device, dtype)

    def __call__(self, v: Tensor, time: float, dt: float) -> None:
        if not self.start <= time < self.end:
            return
        share = min(1.0, (time - self.start) / self.ramp) if self.ramp > 0.0 else 1.0
        if self.damping:
            v[self.rows] *= 1.0 - dt * self.damping
        if self.push.numel():
            v[self.rows] += (share * dt) * self.push
        for column, axis in enumerate(self.axes):
            v[self.rows, axis] = share * self.velocity[column]


def drive(scene: Scene, dtype: torch.dtype, device: str | torch.device) -> Force | None:
    """What the drives of a scene do before every step; None if it has none."""
    if not scene.drives:
        return None
    items = [_Drive(scene, item, dtype, torch.device(device)) for item in scene.drives]

    def apply(world: World, dt: float) -> None:
        v = world.velocity.clone()
        for item in items:
            item(v, world.time, dt)
        world.velocity = v

    return apply


def damage(world: World, start: Tensor) -> Tensor:
    """Damage of every point, 0 intact to 1 broken: the way of alpha from its start to 0, [N].

    Args:
        world: The world.
        start: Alpha at the start, [N]; points that start at 0 or above cannot break.
    """
    start = start.to(world.peak)
    brittle = start < 0.0
    share = 1.0 - world.peak / torch.where(brittle, start, -1.0)
    return torch.where(brittle, share, 0.0).clamp(0.0, 1.0)
