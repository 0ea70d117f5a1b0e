"""Closed triangle meshes to grids of signed distance, for rigid colliders."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np
import torch

from gsfluent.errors import InputError
from gsfluent.spatial.mesh_file import load_mesh
from gsfluent.spatial.neighbours import nearest
from gsfluent.spatial.voxels import distance_transform

_log = logging.getLogger(__name__)

MAX_VALUES = 256
"""Most values of a grid along one axis."""
_LEAST = 1e-5  # spacings
_NEAR = 4.0  # spacings up to which samples are as fine as the grid; at twice that, half as fine
_NEIGHBOURS = 12
"""Triangles looked at for each grid node, nearest sample first."""


@dataclasses.dataclass(frozen=True)
class MeshBody:
    """A mesh as a collider: in a frame on its centre of mass, along its principal axes."""

    values: np.ndarray  # signed distances [m] at the nodes, float32 [X, Y, Z], negative inside
    spacing: float  # distance between nodes [m]
    corner: np.ndarray  # position of the first node in the body frame [m], [3]
    center: np.ndarray  # centre of mass in the frame of the file, times ``scale`` [m], [3]
    axes: np.ndarray  # rotation from the body frame to the frame of the file, [3, 3]
    volume: float  # volume [m^3]
    inertia: np.ndarray  # principal moments at unit density [m^5], [3]


def mesh_body(path: str | Path, scale: float, spacing: float) -> MeshBody:
    """Read a mesh and measure the distance to it on a grid with a margin of three nodes.

    Distances are exact to the nearest of the triangles around the twelve nearest surface samples,
    which are less than a spacing apart for what is up to four spacings away, less than two for
    what is up to eight, and so on: far away to a few hundredths. Inside or outside is decided by
    counting the crossings of vertical lines.

    Args:
        path: Any file that trimesh reads.
        scale: Metres per unit of the file.
        spacing: Wanted distance between nodes [m]; widened so that no axis has more than
            :data:`MAX_VALUES` nodes.

    Raises:
        InputError: The file is missing, unreadable, or its surface is not closed.
    """
    mesh = load_mesh(path)
    mesh.apply_scale(scale)
    if not mesh.is_watertight or abs(mesh.volume) <= 0.0:
        raise InputError(
            f"collider: the surface of {path} is not closed, so it has no inside",
            hint="close its holes (a mesh editor's 'make manifold'), or use a box or a sphere",
        )
    if mesh.volume < 0.0:
        mesh.invert()
    center = np.asarray(mesh.center_mass, dtype=np.float64)
    moments, axes = np.linalg.eigh(np.asarray(mesh.moment_inertia, dtype=np.float64))
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    vertices = (np.asarray(mesh.vertices, dtype=np.float64) - center) @ axes
    triangles = vertices[np.asarray(mesh.faces)]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    spacing = max(spacing, float((high - low).max()) / (MAX_VALUES - 8))
    size = np.ceil((high - low) / spacing).astype(int) + 7
    corner = 0.5 * (low + high) - 0.5 * (size - 1) * spacing
    values = signed_distances(triangles, corner, spacing, size)
    _log.info("%s: %d triangles, %s distances %.3g m apart", path, len(triangles), size, spacing)
    return MeshBody(values, spacing, corner, center, axes, float(mesh.volume), moments)


def signed_distances(
    triangles: np.ndarray,
    corner: np.ndarray,
    spacing: float,
    size: np.ndarray,
    band: float | None = None,
) -> np.ndarray:
    """Signed distances to a closed surface at the nodes of a grid, float32 [X, Y, Z].

    Args:
        triangles: Corners [F, 3, 3] of a closed surface.
        corner: First node [3].
        spacing: Distance between nodes.
        size: Number of nodes along each axis [3].
        band: Distance in spacings up to which it is exact; farther off that to the nearest node
            on the other side is taken, half a spacing more or less. None: farther off to a
            few hundredths.
    """
    grid = [corner[i] + spacing * np.arange(size[i]) for i in range(3)]
    nodes = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = grid_winding(triangles, grid) != 0
    away = np.maximum(distance_transform(~inside), distance_transform(inside))
    steps = np.maximum(away - 0.5, 0.0).reshape(-1).astype(np.float64)
    distance = steps * spacing
    if band is None:
        # from afar the surface is told as well by samples that lie farther apart
        level = np.ceil(np.log2(np.maximum(steps, 1.0) / _NEAR)).clip(min=0.0)
        for far in np.unique(level):
            rows = level == far
            distance[rows] = _distance(nodes[rows], triangles, spacing * 2.0**far)
    else:
        near = steps <= band
        distance[near] = _distance(nodes[near], triangles, spacing)
    distance = np.maximum(distance, _LEAST * spacing)  # a node on the surface has a side as well
    signed = np.where(inside.reshape(-1), -distance, distance).reshape(tuple(size))
    return np.asarray(signed, dtype=np.float32)


def _distance(nodes: np.ndarray, triangles: np.ndarray, spacing: float) -> np.ndarray:
    """Distance of every node from the nearest triangle, [N]."""
    samples, owner = _samples(triangles, 0.7 * spacing)
    where = torch.from_numpy(samples)
    result = np.full(len(nodes), np.inf)
    count = min(_NEIGHBOURS, len(samples))
    for begin in range(0, len(nodes), 65536):
        part, best = nodes[begin : begin + 65536], result[begin : begin + 65536]
        found = owner[nearest(where, part, count, 2.0 * spacing)[1]]
        for k in range(count):  # most neighbours lie on triangles that have been looked at
            new = np.nonzero((found[:, k, None] != found[:, :k]).all(axis=1))[0]
            best[new] = np.minimum(best[new], _point_triangle(part[new], triangles[found[new, k]]))
    return result


def oriented_samples(triangles: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on triangles [F, 3, 3], no farther than ``spacing`` apart, and how they face.

    Returns:
        Points [M, 3], and the outward normal of each times the area it stands for [M, 3].
    """
    points, owner = _samples(triangles, spacing)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    share = np.bincount(owner, minlength=len(triangles)).clip(1)
    return points, (0.5 * cross / share[:, None])[owner]


def _samples(triangles: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on a lattice of every triangle, closer than ``spacing``, and whose they are."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(edges / spacing).astype(int), 1)
    points, owner = [], []
    for n in np.unique(steps):
        which = np.nonzero(steps == n)[0]
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        a, b = i[keep] / n, j[keep] / n
        weight = np.stack([1.0 - a - b, a, b], axis=1)
        points.append(np.einsum("wk,tkc->twc", weight, triangles[which]).reshape(-1, 3))
        owner.append(np.repeat(which, len(weight)))
    return np.concatenate(points), np.concatenate(owner)


def _point_triangle(p: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Distance of points [N, 3] from triangles [N, 3, 3]."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    best = np.full(len(p), np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        edge = v - u
        along = np.einsum("nc,nc->n", p - u, edge)
        length = np.maximum(np.einsum("nc,nc->n", edge, edge), 1e-300)
        foot = u + np.clip(along / length, 0.0, 1.0)[:, None] * edge
        best = np.minimum(best, np.linalg.norm(p - foot, axis=1))
    normal = np.cross(b - a, c - a)
    area = np.maximum(np.einsum("nc,nc->n", normal, normal), 1e-300)
    over = np.ones(len(p), dtype=bool)
    for u, v in ((a, b), (b, c), (c, a)):
        over &= np.einsum("nc,nc->n", np.cross(v - u, p - u), normal) >= 0.0
    height = np.abs(np.einsum("nc,nc->n", p - a, normal)) / np.sqrt(area)
    return np.where(over, np.minimum(best, height), best)


def grid_winding(triangles: np.ndarray, grid: list[np.ndarray]) -> np.ndarray:
    """Winding numbers of a closed surface at the nodes of a grid, int [X, Y, Z]; 0 is outside.

    Counted on vertical lines: one more for each crossing below that enters, one less for each that
    leaves. So parts that overlap are one body, in which the number is 2. A line whose crossings do
    not cancel (triangles wound against each other) is counted by odd and even instead.

    Args:
        triangles: Corners [F, 3, 3].
        grid: Coordinates of the nodes along x, y and z, evenly spaced.
    """
    spacing = grid[0][1] - grid[0][0]
    # Off the lattice by an odd amount, so that no line passes through an edge of a tidy mesh.
    x, y = grid[0] + 3.1e-5 * spacing, grid[1] + 1.7e-5 * spacing
    crossings = np.zeros((len(x), len(y), len(grid[2]) + 1), dtype=np.int32)
    for corners in triangles:
        low, high = corners.min(axis=0), corners.max(axis=0)
        i = np.arange(*np.searchsorted(x, (low[0], high[0])))
        j = np.arange(*np.searchsorted(y, (low[1], high[1])))
        if len(i) == 0 or len(j) == 0:
            continue
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        px, py = x[i][:, None], y[j][None, :]
        u = ((px - ax) * (cy - ay) - (py - ay) * (cx - ax)) / area
        v = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) / area
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        k = np.searchsorted(grid[2], az + u * (bz - az) + v * (cz - az))
        where = np.nonzero(hit)
        # seen from below a face that is wound left-handed looks at us: there the line enters
        step = 1 if area < 0.0 else -1
        np.add.at(crossings, (i[where[0]], j[where[1]], k[where]), step)
    winding = np.cumsum(crossings, axis=2)
    odd = np.cumsum(np.abs(crossings), axis=2) % 2
    counted = np.where(winding[:, :, -1:] == 0, winding, odd)
    return np.asarray(counted[:, :, :-1])
