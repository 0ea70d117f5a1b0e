"""What an object's points say about its shape: separate pieces, floaters, thin parts."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PIECE_SHARE = 0.01
"""A separate cluster with a smaller share of the points is a floater, a larger one a piece."""

_THIN = 0.04
"""Matter within this share of the largest extent from both sides (radius) is called thin."""

_GRID = 48
"""Voxels along the longest side when looking for thin parts."""

_WORTH = 0.0005
"""Share of the volume from which a thin part is named."""


def robust_box(points: Array) -> tuple[Array, Array]:
    """Box of points [N, 3] less 2 per thousand on each side: one floater must not set the scale."""
    if len(points) < 100:
        return points.min(axis=0), points.max(axis=0)
    return np.quantile(points, 0.002, axis=0), np.quantile(points, 0.998, axis=0)


@dataclasses.dataclass(frozen=True)
class Clusters:
    """Clusters of near points."""

    index: NDArray[np.int64]  # cluster of each point, int [N]; 0 is the largest
    pieces: int  # number of clusters that are pieces of the object; those after are floaters
    cell: float  # edge of the voxels that were joined

    @property
    def floaters(self) -> NDArray[np.bool_]:
        """Points that belong to no piece, bool [N]."""
        return self.index >= self.pieces


def cluster(points: Array, cells: int = 48) -> Clusters:
    """Join points whose voxels touch (26 neighbours) and sort the clusters by size.

    Args:
        points: Points [N, 3], N > 0.
        cells: Voxels along the longest side of the robust box, fewer when the points are sparse.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    low, high = robust_box(points)
    # Voxels must not be finer than the points are dense, or a sparse surface falls into dust.
    sample = points[:: max(1, len(points) // 4000)]
    spacing = cKDTree(points).query(sample, k=min(5, len(points)))[0][..., -1]
    cell = max(float((high - low).max()) / cells, 1.2 * float(np.median(spacing)), 1e-12)
    voxels, inverse = np.unique(np.floor((points - low) / cell), axis=0, return_inverse=True)
    pairs = cKDTree(voxels).query_pairs(1.9, output_type="ndarray")  # sqrt(3) < 1.9 < 2
    ones = np.ones(len(pairs), dtype=np.int8)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(voxels), len(voxels)))
    _, label = connected_components(graph, directed=False)
    of_point = label[inverse.reshape(-1)]
    sizes = np.bincount(of_point)
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    pieces = max(1, int((sizes >= _PIECE_SHARE * len(points)).sum()))
    return Clusters(rank[of_point].astype(np.int64), pieces, cell)


def lone_points(points: Array, neighbours: int = 8, factor: float = 2.5) -> NDArray[np.bool_]:
    """Points of a noisy cloud whose neighbours are ``factor`` times the usual distance off [N]."""
    from scipy.spatial import cKDTree

    if len(points) <= neighbours:
        return np.zeros(len(points), dtype=bool)
    distance = cKDTree(points).query(points, k=neighbours + 1)[0][:, -1]
    return np.asarray(distance > factor * np.median(distance))


def thin_parts(points: Array, radii: Array) -> dict[str, Any]:
    """Find where the solid behind a surface of splats is thin.

    The splats are rasterised into voxels, closed, and filled; what an opening with a ball of 4 % of
    the largest extent removes is thin. A shell that does not close is thin everywhere.

    Args:
        points: Surface points [N, 3].
        radii: Their radii [N], same unit.

    Returns:
        ``share`` of the volume that is thin, ``limit`` (thickness below which
        matter counts as thin) and ``parts`` (centre and length of the largest thin pieces), in the
        unit of the points.
    """
    from scipy import ndimage

    from gsfluent.spatial.voxels import distance_transform

    low, high = robust_box(points)
    step = float((high - low).max()) / _GRID
    if not step > 0:
        return {"share": 1.0, "limit": 0.0, "parts": []}
    margin = 5
    # The robust box cuts the outermost points off; they close the surface there.
    slack = 2 * step
    size = np.ceil((high - low) / step).astype(int) + 2 * margin
    inside = ((points >= low - slack) & (points <= high + slack)).all(axis=1)
    shell = np.zeros(size, dtype=bool)
    for offset in _ball_offsets(2):
        reach = np.linalg.norm(offset) * step <= np.maximum(radii[inside], 0.51 * step)
        place = np.floor((points[inside][reach] - low) / step).astype(int) + margin + offset
        place = np.clip(place, 0, size - 1)
        shell[tuple(place.T)] = True
    shell = ndimage.binary_closing(shell, structure=np.ones((3, 3, 3)), iterations=2)
    solid = ndimage.binary_fill_holes(shell)
    ball = _THIN * _GRID
    core = distance_transform(solid) > ball
    # Half a voxel more on the way back: the steps of a voxel surface are not thin parts.
    kept = distance_transform(~core) <= ball + 0.5 if core.any() else core
    thin = solid & ~kept
    label, count = ndimage.label(thin, structure=np.ones((3, 3, 3)))
    sizes = np.bincount(label.ravel(), minlength=count + 1)[1:]
    parts = []
    for index in np.argsort(-sizes, kind="stable")[:8]:
        if sizes[index] < _WORTH * solid.sum():
            break
        where = np.argwhere(label == index + 1)
        extent = (where.max(axis=0) - where.min(axis=0) + 1) * step
        center = low + (where.mean(axis=0) - margin + 0.5) * step
        parts.append({"center": center.tolist(), "extent": extent.tolist()})
    return {
        "share": float(thin.sum() / max(1, solid.sum())),
        "limit": 2 * _THIN * _GRID * step,
        "parts": parts,
    }


def _ball_offsets(radius: int) -> NDArray[np.int64]:
    """Integer offsets within ``radius`` voxels [M, 3]."""
    axis = np.arange(-radius, radius + 1)
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return offsets[np.linalg.norm(offsets, axis=1) <= radius]
