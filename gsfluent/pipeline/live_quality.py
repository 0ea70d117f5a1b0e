"""How fine a grid may be for a session to stay interactive."""

from __future__ import annotations

import torch

from gsfluent.pipeline.particles import POINTS_PER_CELL
from gsfluent.scene import Scene

BUDGET = {"cpu": 6_000, "cuda": 30_000}
"""Material points of quality ``live`` by device: interactive in docs/measured/live.md."""
CELLS = (8, 64)
"""Fewest and most cells along the longest side of the largest solid."""


def live_cells(scene: Scene, device: torch.device) -> int:
    """Cells along the longest side that keep the scene within :data:`BUDGET` on a device.

    The same device type gives the same cells on every machine, so that what was poked can be
    repeated.
    """
    longest = max(
        float((high - low).max())
        for low, high in (body.bounds() for body in scene.bodies if body.solid is not None)
    )
    volume = sum(body.volume for body in scene.bodies)
    budget = BUDGET.get(device.type, BUDGET["cpu"])
    dx = (volume * POINTS_PER_CELL / budget) ** (1.0 / 3.0)
    return min(max(int(longest / dx), CELLS[0]), CELLS[1])
