"""Occupancy of space by splats on a dense grid, and outward normals from it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import _load  # noqa: F401  (loads the compiled operators)
from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient

LEVELS = 5
_MOST_NODES = 1024


class Bulk(NamedTuple):
    """Where a cloud of splats is, known to the host."""

    center: tuple[float, float, float]
    """Mean of the centres [m]."""
    spread: float
    """Root mean square distance from it [m]."""
    reach: float
    """Largest distance from it [m]."""
    size: float
    """Mean standard deviation of the splats [m]."""


def splat_bulk(means: Tensor, scales: Tensor) -> Bulk:
    """Find where a cloud of splats is; those with NaN or infinity are left out. Waits once.

    Args:
        means: Centres [m], shape [N, 3], float32 or float64.
        scales: Standard deviations [m], shape [N, 3].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    check_tensor("splat_bulk", "means", means, shape=("N", 3))
    check_tensor("splat_bulk", "scales", scales, shape=(means.shape[0], 3), like=means)
    x, y, z, spread, reach, size = torch.ops.gsfluent.splat_bulk.default(means, scales).tolist()
    return Bulk((x, y, z), spread, reach, size)


def occupancy(means: Tensor, frame: Tensor, nodes: int, *, full: float) -> Tensor:
    """Share of full matter in every cell of a cube of cells, and of ever coarser ones.

    Centres are scattered with trilinear weights, divided by ``full`` and cut off at one; each
    coarser level averages 2 x 2 x 2 cells of the one before.

    Args:
        means: Centres [m], shape [N, 3], float32 or float64; those beyond the outermost cell
            centres, NaN among them, are left out.
        frame: Corner x, y, z [m] of the grid and its finest cell [m], shape [4].
        nodes: Cells along each side of the finest level, a multiple of 16 up to 1024.
        full: Splats in a cell that counts as full, > 0.

    Returns:
        Values in [0, 1] of the five levels one after the other; level l is a cube of
        ``nodes / 2^l`` cells a side in the order z, y, x.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, ``nodes`` or ``full`` out of range.

    Gradient: none. Sums are in the splats' order on the CPU; in any order on CUDA.
    """
    op = "occupancy"
    check_tensor(op, "means", means, shape=("N", 3))
    check_tensor(op, "frame", frame, shape=(4,), like=means)
    _check_nodes(op, nodes)
    if not (full > 0.0 and math.isfinite(full)):
        raise ValueError(f"{op}: full must be positive, got {full}")
    return torch.ops.gsfluent.occupancy.default(means, frame, nodes, float(full))


def density_normals(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    values: Tensor,
    frame: Tensor,
    nodes: int,
    *,
    eye: Tensor | None = None,
) -> Tensor:
    """Outward vectors of splats: minus the gradient of the smoothed occupancy per cell.

    Their length says how sure they are: about 0.3 on a skin, near zero deep inside, one for flat
    splats (where the gradient is clear it leads and their shortest axis adds to it; on a sheet they
    take that axis, unless it lies across the gradient), zero off the grid. A look four times as
    wide turns what points inward.

    Args:
        means: Centres [m], shape [N, 3], float32 or float64.
        quats: Orientations wxyz, shape [N, 4].
        scales: Standard deviations [m], shape [N, 3].
        values: What :func:`occupancy` gave.
        frame: As there.
        nodes: As there.
        eye: Where the picture is taken from [m], shape [3]: what looks away from it is turned,
            unless both the fine and the coarse gradient are sure of a solid's side. A
            shell has no side to the density, and is seen from outside or from inside.

    Returns:
        Shape [N, 3].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or ``nodes`` is out of range.

    Gradient: none. Formulas: :mod:`gsfluent.ops.reference.density`.
    """
    op = "density_normals"
    check_tensor(op, "means", means, shape=("N", 3))
    n = means.shape[0]
    _check_nodes(op, nodes)
    for name, value, shape in (
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("values", values, (_cells(nodes),)),
        ("frame", frame, (4,)),
        ("eye", eye, (3,)),
    ):
        if value is None:
            continue
        check_tensor(op, name, value, shape=shape, like=means)
    return torch.ops.gsfluent.density_normals.default(
        means, quats, scales, values, frame, nodes, eye
    )


def _check_nodes(op: str, nodes: int) -> None:
    if not (16 <= nodes <= _MOST_NODES and nodes % 16 == 0):
        raise ValueError(f"{op}: nodes must be a multiple of 16 up to {_MOST_NODES}, got {nodes}")


def _cells(nodes: int) -> int:
    return sum((nodes >> level) ** 3 for level in range(LEVELS))


fakes(
    splat_bulk=lambda means, scales: means.new_empty(6, dtype=torch.float64),
    occupancy=lambda means, frame, nodes, full: means.new_empty(_cells(nodes)),
    density_normals=lambda means, *rest: means.new_empty(means.shape),
)
no_gradient("density: no gradient", "splat_bulk", "occupancy", "density_normals")
