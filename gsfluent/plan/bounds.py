"""What limits the size of the cells: thin parts, pieces, the crack band, the time there is.

Each bound names the coarsest grid spacing that it allows, except the budget, which names the
finest. The one that binds is the tightest; the plan says so and warns where the shot's own choice
does not keep to it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from gsfluent.errors import InputError
from gsfluent.materials import BREAKS
from gsfluent.pipeline.matter.points import POINTS_PER_CELL
from gsfluent.scene.scene import Body

THIN_CELLS = 4.0
"""Cells that the thinnest part of a body needs for bending to be felt (solver.md: 4 to 6)."""
PIECE_CELLS = 8.0
"""Cells along a piece from which the number of pieces is that of finer grids, within a quarter: two
on each side of it are the band of a crack (docs/measured/fracture_resolution.md)."""
DAMAGE_CELLS = 3.0
"""Cells that a damage length must hold."""
CELLS = (8, 512)
"""Fewest and most cells along the largest body that a budget is turned into."""


@dataclasses.dataclass(frozen=True)
class Bound:
    """One limit of the grid spacing."""

    name: str  # ``thinnest part``, ``fragment size``, ``damage length`` or ``time budget``
    dx: float  # The spacing [m]: the coarsest, or with ``least`` the finest
    least: bool  # Whether it limits from below
    why: str  # In words
    kept: bool  # Whether the plan keeps to it

    def row(self) -> dict[str, Any]:
        """Plain values."""
        return {"bound": self.name, "dx": self.dx, "side": "dx >=" if self.least else "dx <=",
                "kept": self.kept, "why": self.why}  # fmt: skip


def bounds_of(
    bodies: Sequence[Body], dx: float, *, strike: float, budget: float | None = None
) -> tuple[list[Bound], str]:
    """All bounds of a scene, and the name of the one that binds.

    Args:
        bodies: Bodies of the scene.
        dx: The spacing that is planned [m].
        strike: Speed of the fastest strike [m/s]; sets the size of pieces.
        budget: Finest spacing that the time budget allows [m], if there is one.

    Returns:
        The bounds, tightest first, and which one binds: the budget when the tightest other bound
        asks for finer cells than it allows, else that bound; ``none`` without any.
    """
    found: list[Bound] = []

    def need(name: str, length: float, cells: float, why: str) -> None:
        found.append(Bound(name, length / cells, False, why, dx <= length / cells))

    for body in bodies:
        if body.solid is None:
            continue
        thin = thickness(body)
        why = f"{body.name}: {_length(thin)} thick at its thinnest, {THIN_CELLS:g} cells"
        need("thinnest part", thin, THIN_CELLS, why)
        piece = fragment_size(body, strike)
        if piece is not None:
            why = (
                f"{body.name}: pieces of about {_length(piece)}, {PIECE_CELLS:g} cells each; "
                "coarser cells make fewer and larger ones"
            )
            need("fragment size", piece, PIECE_CELLS, why)
        material = body.material
        if material.variation > 0.0 and material.grain > 0.0 and material.law in BREAKS:
            why = f"{body.name}: strength varies over {_length(material.grain)}, "
            need("damage length", material.grain, DAMAGE_CELLS, f"{why}{DAMAGE_CELLS:g} cells")
    found.sort(key=lambda bound: bound.dx)
    binding = found[0].name if found else "none"
    if budget is not None:
        why = f"finer cells than {_length(budget)} take longer"
        found.insert(0, Bound("time budget", budget, True, why, dx >= budget * (1.0 - 1e-9)))
        if binding == "none" or found[1].dx < budget:
            binding = "time budget"
    return found, binding


def thickness(body: Body) -> float:
    """Thickness of the thinnest walls of a body [m].

    Twice the 5 % quantile of the depth of the places that lie deeper than all their neighbours.
    """
    solid = body.solid
    if solid is None:
        return 2.0 * body.radius
    depth = solid.depth.float().cpu()
    top = torch.nn.functional.max_pool3d(depth[None, None], 3, 1, 1)[0, 0]
    ridge = (depth >= top - 0.25 * solid.voxel) & (depth > 0.75 * solid.voxel)
    if not bool(ridge.any()):
        return 2.0 * float(depth.amax()) * body.frame.scale
    return 2.0 * float(depth[ridge].quantile(0.05)) * body.frame.scale


def fragment_size(body: Body, strike: float) -> float | None:
    """Size of the pieces [m] that a strike makes; None where it makes none.

    Grady and Kipp (1985), with the fracture energy put as the elastic energy at failure over the
    body's size: a strike ``n`` times faster than the slowest that breaks the body makes pieces
    ``n^(2/3)`` times smaller than the body.
    """
    material = body.material
    if material.law not in BREAKS or strike <= 0.0:
        return None
    limit = material.breaking_speed
    if not math.isfinite(limit) or strike <= limit:
        return None
    return float(body.volume ** (1 / 3) * (limit / strike) ** (2 / 3))


def budget_spacing(
    volume: float,
    *,
    wave: float,
    frame: float,
    seconds: float,
    per_point_step: float,
    cfl: float = 0.5,
    points_per_cell: int = POINTS_PER_CELL,
) -> float:
    """Finest grid spacing [m] that a time budget allows when only points cost something.

    ``dx = (V ppc T_f c tau / (C t))^(1/4)``: a frame has ``T_f c / (C dx)`` steps of ``V ppc /
    dx^3`` points at ``tau`` seconds each.

    Args:
        volume: Volume of the matter V [m^3].
        wave: Wave speed plus speed c [m/s].
        frame: Simulated time of a frame T_f [s].
        seconds: Wall time for it t [s].
        per_point_step: Wall time of a point in a step tau [s].
        cfl: Courant number C.
        points_per_cell: Points per cell.

    Raises:
        ValueError: A number is not positive.
    """
    for name, value in (("volume", volume), ("wave", wave), ("frame", frame), ("cfl", cfl),
                        ("seconds", seconds), ("per_point_step", per_point_step)):  # fmt: skip
        if not value > 0.0:
            raise ValueError(f"budget_spacing: {name} must be positive, got {value}")
    work = volume * points_per_cell * frame * wave * per_point_step
    return float((work / (cfl * seconds)) ** 0.25)


def choose_cells(cost: Callable[[int], float], budget: float) -> int:
    """Most cells along the largest body whose frames keep to a budget [s]; cost grows with them.

    Raises:
        InputError: Not even the coarsest grid keeps to it.
    """
    low, high = CELLS
    least = cost(low)
    if least > budget:
        raise InputError(
            f"solve.seconds_per_frame {budget:g}: even {low} cells take {least:.3g} s a frame here",
            f"allow {1.1 * least:.2g} s, take more frames a second, or use solve.quality",
        )
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if cost(middle) <= budget else (low, middle)
    return high if cost(high) <= budget else low


def _length(metres: float) -> str:
    return f"{1000 * metres:.3g} mm" if metres < 1.0 else f"{metres:.3g} m"
