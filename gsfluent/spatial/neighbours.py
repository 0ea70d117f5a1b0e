"""Exact nearest neighbours of points: a tree on the CPU, a grid of cells on a GPU."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops

_SIDE = 1 << 20  # cells along an axis that a key can tell apart
_NEAR = 3.0  # cells around the queries within which points are looked at first
_FEW = 8  # times as many points as queries, from which that pays
_ROOMS = 1 << 21  # cells that are marked, at most


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
    some = _around(points, queries, _NEAR * cell)
    if some is None or len(some) < count:
        return _nearest_rows(points, queries, count, cell)
    distance, index = _nearest_rows(points[some], queries, count, cell)
    index = some[index]
    far = (distance[:, -1] > _NEAR * cell).nonzero()[:, 0]
    if len(far):
        distance[far], index[far] = _nearest_rows(points, queries[far], count, cell)
    return distance, index


def _nearest_rows(
    points: Tensor, queries: Tensor, count: int, cell: float
) -> tuple[Tensor, Tensor]:
    if points.device.type == "cpu":
        found = nearest(points, queries.detach().double().numpy(), count, cell)
        distance, index = (torch.from_numpy(part) for part in found)
    else:
        distance, index = grid_search(
            points.detach().double(), queries.detach().double(), count, cell
        )
    return _in_order(distance, index.to(torch.int64))


def _around(points: Tensor, queries: Tensor, margin: float) -> Tensor | None:
    """Rows of the points that are within a margin of any query, and some more, in their order.

    None where asking all of them costs no more.
    """
    if len(points) < _FEW * len(queries) or not len(queries) or not 0.0 < margin < math.inf:
        return None
    asked = queries.detach().double()
    low, high = asked.amin(0) - margin, asked.amax(0) + margin
    extent = (high - low).tolist()
    if not all(math.isfinite(side) for side in extent):
        return None
    edge = margin
    while math.prod(math.floor(side / edge) + 1 for side in extent) > _ROOMS:
        edge *= 1.5
    size = [math.floor(side / edge) + 1 for side in extent]
    marked = torch.zeros(size, dtype=torch.float32, device=points.device)
    marked[((asked - low) / edge).long().unbind(1)] = 1.0
    # what is within an edge is in the same room or in one beside it
    near = torch.nn.functional.max_pool3d(marked[None, None], 3, 1, 1)[0, 0] > 0.0
    room = ((points.detach().double() - low) / edge).floor().long()
    most = torch.tensor(size, device=points.device) - 1
    within = ((room >= 0) & (room <= most)).all(dim=1)
    x, y, z = torch.minimum(room.clamp(min=0), most).unbind(1)
    return (within & near[x, y, z]).nonzero()[:, 0]


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

    Groups are searched as one set: each stands at a place of its own on a coarse lattice, so far
    from the others that none of their points is asked.

    Args:
        points: Where to look, [N, 3], world units.
        group: Of each point, int64 [N].
        queries: [M, 3], world units.
        wanted: Group in which each query looks, int64 [M].
        count: Neighbours per query.
        cell: As for :func:`nearest`.
        reach: Distance beyond which nothing is looked for [world units]; far queries cost most.

    Returns:
        Distances float64 [M, count], ascending, infinite where a group has too few points within
        reach, and rows int64 [M, count], -1 there.
    """
    some = _around(points, queries, _NEAR * cell)
    if some is None:
        return _nearest_in_group(points, group, queries, wanted, count, cell, reach)
    distance, index = _nearest_in_group(
        points[some], group[some], queries, wanted, count, cell, min(reach, _NEAR * cell)
    )
    index = torch.where(index < 0, index, some[index.clamp(min=0)]) if len(some) else index
    if reach > _NEAR * cell:
        far = distance[:, -1].isinf().nonzero()[:, 0]
        if len(far):
            distance[far], index[far] = _nearest_in_group(
                points, group, queries[far], wanted[far], count, cell, reach
            )
    return distance, index


def _nearest_in_group(
    points: Tensor,
    group: Tensor,
    queries: Tensor,
    wanted: Tensor,
    count: int,
    cell: float,
    reach: float,
) -> tuple[Tensor, Tensor]:
    distance = torch.full((len(queries), count), math.inf, dtype=torch.float64)
    distance = distance.to(points.device)
    index = torch.full_like(distance, -1, dtype=torch.int64)
    names, place = torch.unique(group, return_inverse=True)
    slot = torch.searchsorted(names, wanted).clamp(max=max(len(names) - 1, 0))
    asks = (names[slot] == wanted).nonzero()[:, 0] if len(names) else slot[:0]
    if len(asks) == 0:
        return distance, index
    places, asked = points.detach().double(), queries.detach()[asks].double()
    both = torch.cat([places, asked])
    extent = max(float((both.amax(0) - both.amin(0)).amax()), cell)
    # a power of two: coordinates of single precision keep their digits, and ties stay ties
    pitch = 2.0 ** (math.ceil(math.log2(extent)) + 2)
    side = math.ceil(len(names) ** (1 / 3))

    def apart(x: Tensor, number: Tensor) -> Tensor:
        lattice = [number // side**2, number // side % side, number % side]
        return x + pitch * torch.stack(lattice, dim=1)

    places, asked = apart(places, place), apart(asked, slot[asks])
    most = min(count, len(points))
    if points.device.type == "cpu":
        from scipy.spatial import cKDTree

        found = cKDTree(places.numpy()).query(
            asked.numpy(),
            k=list(range(1, most + 1)),
            distance_upper_bound=min(2.0 * extent, math.nextafter(reach, math.inf)),
        )
        near, rows = (torch.from_numpy(np.asarray(part)) for part in found)
        rows = rows.to(torch.int64)
    else:
        near, rows = grid_search(places, asked, most, min(cell, reach), min(extent, reach))
        near = torch.where(near <= reach, near, math.inf)
    rows = torch.where(near.isfinite(), rows, len(points))
    near, rows = _in_order(near, rows)
    distance[asks, :most] = near
    index[asks, :most] = torch.where(near.isfinite(), rows, -1)
    return distance, index


def _in_order(distance: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """By distance, and by row where that is the same."""
    index, order = index.sort(dim=1)
    distance, order = distance.gather(1, order).sort(dim=1, stable=True)
    return distance, index.gather(1, order)


def grid_search(
    points: Tensor, queries: Tensor, count: int, cell: float, reach: float = math.inf
) -> tuple[Tensor, Tensor]:
    """As :func:`nearest`, by cells; double precision, any device.

    What lies in the 27 cells around a query is complete up to a distance of one cell. Queries whose
    last neighbour is farther ask a grid twice as coarse, up to cells of ``reach``, beyond which
    nothing is looked for: what is not found is at an infinite distance.
    """
    low = torch.minimum(points.amin(0), queries.amin(0)) if len(queries) else points.amin(0)
    high = torch.maximum(points.amax(0), queries.amax(0)) if len(queries) else points.amax(0)
    ends = torch.stack([low, high]).tolist()
    extent = max(*(b - a for a, b in zip(*ends, strict=True)), 1e-300)
    cell = max(cell, extent / (_SIDE - 4))
    reach = min(extent, reach)
    distance = torch.full((len(queries), count), math.inf, dtype=points.dtype, device=points.device)
    index = torch.zeros((len(queries), count), dtype=torch.long, device=points.device)
    left = torch.arange(len(queries), device=points.device)
    while len(left):
        last = cell >= reach
        order, starts, keys = _sorted_cells(points, low, cell)
        square, rows = ops.nearest_in_cells(
            points, queries[left], order, starts, keys, ends[0], cell, count
        )
        distance[left], index[left] = square.sqrt(), rows
        left = left[:0] if last else left[distance[left, -1] > cell]
        cell = min(2.0 * cell, reach) if reach > cell else 2.0 * cell
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
