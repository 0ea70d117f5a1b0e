"""Thin shells: how thick the walls of a solid are, beside the grid that is to carry them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.spatial.voxels import distance_transform, surface

_STEP = 0.25  # voxels of a march
_FIRST = 0.75  # voxels below the surface where it starts: within a wall of one and a half
WALL_CELLS = 3.0
"""Cells that a wall needs to break as a wall: a crack through it is two cells wide or more."""
_SHARE = 0.05  # of the surface that may be thinner


def wall_thickness(field: SignedDistance, most: float) -> tuple[Tensor, Tensor]:
    """How far the solid goes on below each surface voxel.

    From the surface along the inward normal ``-grad phi`` until ``phi`` is positive again.

    Args:
        field: The solid.
        most: Thickness [world units] from which a wall is thick enough; longer marches stop there.

    Returns:
        Points on the surface [M, 3], and the thickness below each [world units], at most ``most``,
        [M]. M is 0 when nothing is inside.
    """
    skin = torch.from_numpy(surface(field.inside.cpu().numpy()))
    index = skin.to(field.values.device).nonzero()
    if len(index) == 0:
        empty = field.values.new_zeros(0)
        return empty.reshape(0, 3), empty
    slopes = torch.stack(torch.gradient(field.values), -1)[tuple(index.T)]
    normal = torch.nn.functional.normalize(slopes, dim=1)
    center = field.origin.to(field.values) + (index + 0.5) * field.voxel
    start = center - field.values[tuple(index.T)][:, None] * normal
    thickness = torch.full_like(start[:, 0], float(most))
    alive = torch.arange(len(start), device=start.device)
    before = torch.full_like(thickness, -1.0)
    depth = _FIRST * field.voxel
    while depth < most and len(alive):
        value = field.at(start[alive] - depth * normal[alive])
        through = value > 0
        # where the line from the last sample crosses zero
        last = before[alive]
        back = (value / (value - last).clamp_min(1e-12)).clamp(0.0, 1.0) * _STEP * field.voxel
        thickness[alive[through]] = (depth - back[through]).clamp_min(0.0)
        before[alive] = value
        alive = alive[~through]
        depth += _STEP * field.voxel
    return start, thickness.clamp_max(most)


def walls(field: SignedDistance, most: float = 12.0) -> dict[str, float | None]:
    """How thick the walls of a solid are, over its surface.

    Args:
        field: The solid.
        most: Thickness [voxels] from which something is no wall; None stands for that.

    Returns:
        ``median`` and ``p5``, the 5 % quantile [world units].
    """
    _, thickness = wall_thickness(field, most * field.voxel)
    found: dict[str, float | None] = {"median": None, "p5": None}
    if len(thickness):
        chosen = thickness[:: max(1, len(thickness) // 100_000)].double()
        for name, share in (("median", 0.5), ("p5", 0.05)):
            value = float(chosen.quantile(share))
            found[name] = value if value < 0.999 * most * field.voxel else None
    return found


def thin_shells(
    field: SignedDistance, cell: float, *, gaussian_size: float | None = None, unit: str = ""
) -> dict[str, Any]:
    """Flag walls that a simulation grid cannot carry.

    Thin is what is thinner than three cells and farther than a cell from where a ball of three
    cells fits in: flakes and bumps of a rough surface ride on thick matter and are no walls.

    Args:
        field: The solid, world units.
        cell: Edge of a cell of the simulation [world units].
        gaussian_size: Typical standard deviation of the splats [world units]: walls thinner than
            two of them are not known any better.
        unit: What lengths are called in the warning.

    Returns:
        ``cell``, ``cells`` (of the thinnest; None without a warning), ``limit`` (three cells),
        ``share`` of the surface that is thinner, ``thinnest`` (the 5 % quantile) and ``median``
        (both None when thicker than eight cells), ``middle`` (of the thin surface, [3], or None),
        ``cells_needed`` (how many times finer a grid would carry the thinnest), ``warning`` and
        ``hint`` (texts, or None).

    Raises:
        ValueError: ``cell`` is not positive.
    """
    if not (math.isfinite(cell) and cell > 0):
        raise ValueError(f"thin_shells: cell must be positive, got {cell}")
    limit, most = WALL_CELLS * cell, 8.0 * cell
    points, thickness = wall_thickness(field, most)
    thin = (thickness < limit) & (_from_core(field, points, 0.5 * limit) > 0.5 * limit + cell)
    share = float(thin.double().mean()) if len(thickness) else 0.0
    report: dict[str, Any] = {
        "cell": cell,
        "limit": limit,
        "share": share,
        "cells": None,
        "thinnest": None,
        "median": None,
        "middle": None,
        "cells_needed": 1.0,
        "warning": None,
        "hint": None,
    }
    if len(thickness) == 0:
        return report
    walls = thickness[thin | (thickness >= limit)].double()
    if len(walls) == 0:
        walls = thickness.double()
    low, middle = walls.quantile(torch.tensor([0.05, 0.5]).to(walls)).tolist()
    report["thinnest"] = low if low < most else None
    report["median"] = middle if middle < most else None
    if share > 0:
        report["middle"] = points[thin].mean(dim=0).tolist()
    if share <= _SHARE:
        return report
    thinnest = max(low, field.voxel)
    report["cells_needed"] = limit / thinnest
    report["cells"] = thinnest / cell
    report["warning"] = (
        f"{100 * share:.0f} % of the surface stands on walls under {WALL_CELLS:g} cells "
        f"({limit:.3g}{unit}), 5 % of the walls under {report['cells']:.2g} cells "
        f"({thinnest:.3g}{unit})"
    )
    hint = f"a grid {report['cells_needed']:.2g} times finer"
    if gaussian_size is not None and thinnest < 2.0 * gaussian_size:
        hint += "; the splats are as large as the wall is thick: reconstruct at a larger image_size"
    if field.voxel > 0.5 * thinnest:
        hint += "; a finer fill.resolution would know the wall better"
    report["hint"] = hint
    return report


def _from_core(field: SignedDistance, points: Tensor, depth: float) -> Tensor:
    """Distance of points [M, 3] from what lies deeper than ``depth``; infinite without any."""
    core = (field.values <= -depth).cpu().numpy()
    if not core.any():
        return torch.full_like(points[:, 0], math.inf)
    distance = distance_transform(~core, field.values.device) * field.voxel
    return field.replace(values=torch.from_numpy(distance).to(field.values)).at(points)
