"""How gsfluent answers what the fracture scenes of FractureBench add: drives, damage, stresses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.world.driver import World


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

        self.mass = torch.from_numpy(scene.mass).to(device)[self.rows, None]
        self.impulse = torch.zeros(3, dtype=torch.float64, device=device)

    def __call__(self, v: Tensor, time: float, dt: float) -> None:
        """Change the velocities of a step in place."""
        if not self.start <= time < self.end:
            return
        before = v[self.rows].double().clone()
        share = min(1.0, (time - self.start) / self.ramp) if self.ramp > 0.0 else 1.0
        if self.damping:
            v[self.rows] *= 1.0 - dt * self.damping
        if self.push.numel():
            v[self.rows] += (share * dt) * self.push
        for column, axis in enumerate(self.axes):
            v[self.rows, axis] = share * self.velocity[column]
        self.impulse += (self.mass * (v[self.rows].double() - before)).sum(dim=0)


class Drives:
    """What the drives of a scene do before every step: a force of :class:`World`."""

    def __init__(self, scene: Scene, dtype: torch.dtype, device: str | torch.device):
        self._items = [_Drive(scene, item, dtype, torch.device(device)) for item in scene.drives]

    def __call__(self, world: World, dt: float) -> None:
        """Change the velocities of the world."""
        v = world.velocity.clone()
        for item in self._items:
            item(v, world.time, dt)
        world.velocity = v

    @property
    def impulse(self) -> Tensor:
        """Given by each drive so far [N s], float64 [D, 3]."""
        return torch.stack([item.impulse for item in self._items])


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
