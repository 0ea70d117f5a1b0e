"""Exact nearest neighbours of points: a tree on the CPU, a grid of cells on a GPU."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

_CHUNK = 1 << 25  # candidate pairs at a time
_SIDE = 1 << 20  # cells along an axis that a key can tell apart


def nearest(
    points: Tensor, queries: np.ndarray, count: int, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points of every query.

    Args:
        points: Where to look, [N, 3], world units; the search runs on their device.
        queries: [M, 3], world units.
        count: Neighbours per query, at most N.
        cell: Edge of the first grid that a GPU tries [world units]; about the distance of the
            neighbours.

    Returns:
        Distances float64 [M, count], ascending, and rows of ``points`` int64 [M, count].

    Raises:
        ValueError: ``count`` is not in 1..N, or ``cell`` is not positive.
    """
    if not 1 <= count <= len(points):
        raise ValueError(f"nearest: count must be in 1..{len(points)}, got {count}")
    if not (math.isfinite(cell) and cell > 0):
        raise ValueError(f"nearest: cell must be positive, got {cell}")
    if points.device.type == "cpu":
        from scipy.spatial import cKDTree

        tree = cKDTree(points.detach().double().numpy())
        distance, index = tree.query(queries, k=count)
        shape = (len(queries), count)
        return np.asarray(distance).reshape(shape), np.asarray(index).reshape(shape)
    found = grid_search(
        points.detach().double(), torch.from_numpy(queries).to(points.device), count, cell
    )
    return found[0].cpu().numpy(), found[1].cpu().numpy()


def nearest_rows(points: Tensor, queries: Tensor, count: int, cell: float) -> tuple[Tensor, Tensor]:
    """As :func:`nearest` with tensors, all on the device of ``points``.

    The CPU and a GPU find the same neighbours; of those at exactly the same distance the one with
    the lower row comes first.

    Args:
        points: Where to look, [N, 3], world units.
        queries: [M, 3], world units.
        count: Neighbours per query, at most N.
        cell: As for :func:`nearest`.

    Returns:
        Distances float64 [M, count], ascending, and rows int64 [M, count].

    Raises:
        ValueError: As :func:`nearest`.
    """
    if points.device.type == "cpu":
        found = nearest(points, queries.detach().double().numpy(), count, cell)
        distance, index = (torch.from_numpy(part) for part in found)
    else:
        distance, index = grid_search(
            points.detach().double(), queries.detach().double(), count, cell
        )
    index, order = index.to(torch.int64).sort(dim=1)
    distance, order = distance.gather(1, order).sort(dim=1, stable=True)
    return distance, index.gather(1, order)


def grid_search(points: Tensor, queries: Tensor, count: int, cell: float) -> tuple[Tensor, Tensor]:
    """As :func:`nearest`, by cells; double precision, any device.

    What lies in the 27 cells around a query is complete up to a distance of one cell. Queries whose
    last neighbour is farther ask a grid twice as coarse.
    """
    low = torch.minimum(points.amin(0), queries.amin(0)) if len(queries) else points.amin(0)
    high = torch.maximum(points.amax(0), queries.amax(0)) if len(queries) else points.amax(0)
    extent = max(float((high - low).amax()), 1e-300)
    cell = max(cell, extent / (_SIDE - 4))
    distance = torch.full((len(queries), count), math.inf, dtype=points.dtype, device=points.device)
    index = torch.zeros((len(queries), count), dtype=torch.long, device=points.device)
    left = torch.arange(len(queries), device=points.device)
    while len(left):
        last = cell >= extent
        order, starts, keys = _sorted_cells(points, low, cell)
        pairs = _candidates(queries[left], low, cell, starts, keys)
        for part in _parts(pairs[1].sum(1)):
            rows = left[part]
            square, place = _closest(
                points, order, queries[rows], pairs[0][part], pairs[1][part], count
            )
            distance[rows], index[rows] = square.sqrt(), place
        left = left[left.new_zeros(0)] if last else left[distance[left, -1] > cell]
        cell *= 2.0
    return distance, index


def _key(cells: Tensor) -> Tensor:
    """One number per cell [..., 3]; neighbours of border cells stay apart from the others."""
    x, y, z = (cells + 1).unbind(-1)
    return (x * _SIDE + y) * _SIDE + z


def _sorted_cells(points: Tensor, low: Tensor, cell: float) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of the points by cell, where each occupied cell starts (and the end), and its key."""
    key, order = _key(((points - low) / cell).long()).sort()
    keys, counts = torch.unique_consecutive(key, return_counts=True)
    return order, torch.cat([counts.new_zeros(1), counts.cumsum(0)]), keys


def _candidates(
    queries: Tensor, low: Tensor, cell: float, starts: Tensor, keys: Tensor
) -> tuple[Tensor, Tensor]:
    """First row (in cell order) and number of points of the 27 cells around queries, [M, 27]."""
    steps = torch.cartesian_prod(*[torch.arange(-1, 2, device=queries.device)] * 3)
    around = _key(((queries - low) / cell).long()[:, None] + steps)
    slot = torch.searchsorted(keys, around).clamp(max=len(keys) - 1)
    there = keys[slot] == around
    return starts[slot], torch.where(there, starts[slot + 1] - starts[slot], 0)


def _parts(totals: Tensor) -> list[slice]:
    """Runs of queries whose padded candidates stay below the chunk."""
    parts, start, widest = [], 0, 1
    for place, total in enumerate(totals.tolist()):
        wider = max(widest, total)
        if place > start and wider * (place + 1 - start) > _CHUNK:
            parts.append(slice(start, place))
            start, wider = place, max(1, total)
        widest = wider
    if len(totals) > start:
        parts.append(slice(start, len(totals)))
    return parts


def _closest(
    points: Tensor, order: Tensor, queries: Tensor, first: Tensor, number: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Squared distances and rows of the ``count`` nearest candidates; infinite where too few."""
    totals = number.sum(1)
    cells = number.flatten()
    owner = torch.repeat_interleave(torch.arange(len(cells), device=cells.device), cells)
    begin = cells.cumsum(0) - cells
    within = torch.arange(len(owner), device=cells.device) - begin[owner]
    rows = order[first.flatten()[owner] + within]
    query = owner // 27
    column = torch.arange(len(owner), device=cells.device) - (totals.cumsum(0) - totals)[query]
    square = (points[rows] - queries[query]).square().sum(1)
    width = max(count, int(totals.max()))
    table = torch.full((len(queries), width), math.inf, dtype=points.dtype, device=points.device)
    place = torch.zeros((len(queries), width), dtype=torch.long, device=points.device)
    table[query, column], place[query, column] = square, rows
    best, chosen = table.topk(count, dim=1, largest=False, sorted=True)
    return best, place.gather(1, chosen)
