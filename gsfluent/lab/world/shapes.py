"""Lattices of material points (boxes, balls, discs, sheets), and rows of what they are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def box(lower: Sequence[float], size: Sequence[float], spacing: float) -> Tensor:
    """Points of a cubic lattice at the centres of the cells that fill a box.

    Args:
        lower: Lower corner [m].
        size: Edge lengths [m]; each is rounded to a whole number of ``spacing``.
        spacing: Distance of neighbours [m].

    Returns:
        Positions, float64 [N, 3]; each point stands for ``spacing**3``.
    """
    axes = []
    for low, edge in zip(lower, size, strict=True):
        count = round(edge / spacing)
        axes.append(low + (torch.arange(count, dtype=torch.float64) + 0.5) * spacing)
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def ball(center: Sequence[float], radius: float, spacing: float) -> Tensor:
    """Points of the lattice of :func:`box` (a cell corner at the centre) inside a ball."""
    half = math.ceil(radius / spacing) * spacing
    points = box([-half] * 3, [2 * half] * 3, spacing)
    inside = points[points.norm(dim=1) <= radius]
    return inside + torch.tensor([float(c) for c in center], dtype=torch.float64)


def disc(center: Sequence[float], radius: float, thickness: float, spacing: float) -> Tensor:
    """Points inside a flat cylinder around the z axis through ``center`` (its middle)."""
    half = math.ceil(radius / spacing) * spacing
    points = box([-half, -half, -0.5 * thickness], [2 * half, 2 * half, thickness], spacing)
    inside = points[points[:, :2].norm(dim=1) <= radius]
    return inside + torch.tensor([float(c) for c in center], dtype=torch.float64)


def sheet(lower: Sequence[float], size: Sequence[float], dx: float, per_cell: int = 2) -> Tensor:
    """One layer of points in the x-y plane, in the middle of the cell 0 <= z <= dx, [N, 3].

    Each point stands for ``(dx / per_cell)**2 * dx``.

    Args:
        lower: Lower x and y [m].
        size: Extents in x and y [m], whole numbers of ``dx / per_cell``.
        dx: Node spacing [m].
        per_cell: Points along each edge of a cell.
    """
    step = dx / per_cell
    axes = [
        low + (torch.arange(round(edge / step), dtype=torch.float64) + 0.5) * step
        for low, edge in zip(lower, size, strict=True)
    ]
    flat = torch.cartesian_prod(*axes)
    return torch.cat([flat, torch.full((flat.shape[0], 1), 0.5 * dx, dtype=flat.dtype)], dim=1)


def rotation(axis: Sequence[float], angle: float) -> Tensor:
    """Rotation matrix by ``angle`` [rad] about ``axis`` (Rodrigues), float64 [3, 3]."""
    length = math.sqrt(sum(float(a) ** 2 for a in axis))
    x, y, z = (float(a) / length for a in axis)
    k = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    one = torch.eye(3, dtype=torch.float64)
    return one + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)


def moduli(young: float, poisson: float) -> tuple[float, float]:
    """Shear and bulk modulus [Pa] of Young's modulus [Pa] and Poisson's ratio."""
    return young / (2.0 * (1.0 + poisson)), young / (3.0 * (1.0 - 2.0 * poisson))


def parameters(young: float, poisson: float, density: float, **columns: float) -> Tensor:
    """One row of ``params``, float64 [8] (columns as in :func:`gsfluent.ops.return_mapping`).

    Args:
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: [kg/m^3].
        columns: ``c2`` to ``c7``: further columns by number, whose meaning depends on the law.
    """
    row = torch.zeros(8, dtype=torch.float64)
    row[0], row[1] = moduli(young, poisson)
    row[6] = density
    for name, value in columns.items():
        row[int(name.removeprefix("c"))] = value
    return row


def nacc(
    young: float,
    poisson: float,
    density: float,
    *,
    friction: float,
    cohesion: float,
    hardening: float,
    shear_damage: float = 0.0,
) -> Tensor:
    """One NACC row of ``params``, float64 [8] (see :func:`gsfluent.ops.return_mapping`)."""
    return parameters(
        young, poisson, density, c2=friction, c3=cohesion, c4=hardening, c5=shear_damage
    )


def wave_speed(row: Tensor) -> float:
    """Speed of the pressure wave of a solid's row at rest [m/s]."""
    return math.sqrt((float(row[1]) + 4.0 / 3.0 * float(row[0])) / float(row[6]))
