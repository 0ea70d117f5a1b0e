"""Exact nearest neighbours of points, the same on every device."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops


def nearest(
    points: Tensor, queries: np.ndarray, count: int, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`nearest_rows`, of and to NumPy; the search runs on the device of ``points``."""
    found = nearest_rows(points, torch.from_numpy(queries).to(points.device), count, cell)
    return found[0].cpu().numpy(), found[1].cpu().numpy()


def nearest_rows(points: Tensor, queries: Tensor, count: int, cell: float) -> tuple[Tensor, Tensor]:
    """Nearest points of every query; of those at the same distance the lower row comes first.

    Args:
        points: Where to look, [N, 3], world units.
        queries: [M, 3], world units, on the same device.
        count: Neighbours per query, at most N.
        cell: Edge of the first cells that are looked at [world units]; about the distance of the
            neighbours.

    Returns:
        Distances float64 [M, count], ascending, and rows int64 [M, count].

    Raises:
        ValueError: ``count`` is not in 1..N, or ``cell`` is not positive.
    """
    if not 1 <= count <= len(points):
        raise ValueError(f"nearest: count must be in 1..{len(points)}, got {count}")
    if not (math.isfinite(cell) and cell > 0):
        raise ValueError(f"nearest: cell must be positive, got {cell}")
    return ops.nearest_points(points.detach().double(), queries.detach().double(), count, cell)


def nearest_in_group(
    points: Tensor,
    group: Tensor,
    queries: Tensor,
    wanted: Tensor,
    count: int,
    cell: float,
    reach: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """Nearest points of one's own group, for all groups at once.

    Args:
        points: Where to look, [N, 3], world units.
        group: Of each point, int64 [N].
        queries: [M, 3], world units.
        wanted: Group in which each query looks, int64 [M].
        count: Neighbours per query.
        cell: As for :func:`nearest_rows`.
        reach: Distance beyond which nothing is looked for [world units]; far queries cost most.

    Returns:
        Distances float64 [M, count], ascending, infinite where a group has too few points within
        reach, and rows int64 [M, count], -1 there.
    """
    return ops.nearest_points(
        points.detach().double(), queries.detach().double(), count, cell,
        group=group, asked=wanted, reach=reach,
    )  # fmt: skip
