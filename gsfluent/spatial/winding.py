"""Generalised winding numbers of oriented points (Barill et al. 2018).

``w(q) = sum_i a_i n_i . (p_i - q) / (4 pi |p_i - q|^3)``: 1 inside a closed surface, 0 outside, and
smooth across the holes of an open one, where 1/2 closes them as a soap film would roughly. Far
clusters of points count as one dipole, near ones point by point.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

_FAR = 2.5  # radii from a cluster's centre; the dipole alone is then good to a few per cent of it
_CLUSTER = 256  # points
_CHUNK = 4_000_000  # pairs at a time


@torch.no_grad()
def winding_numbers(queries: Tensor, points: Tensor, areas: Tensor, *, soft: float = 0.0) -> Tensor:
    """Winding numbers [M] of an oriented point cloud.

    Args:
        queries: Where, [M, 3].
        points: Points on the surface [N, 3].
        areas: Their outward normals times the area they stand for [N, 3].
        soft: Length below which a point is no longer a point, about half the spacing: keeps values
            near the surface finite.

    Raises:
        ValueError: Shapes do not match.
    """
    if points.shape != areas.shape or points.dim() != 2 or points.shape[1] != 3:
        got = f"{list(points.shape)} and {list(areas.shape)}"
        raise ValueError(f"winding_numbers: points and areas must both be [N, 3], got {got}")
    total = queries.new_zeros(len(queries))
    points, areas = points.to(queries), areas.to(queries)
    for members in _clusters(points):
        place, weight = points[members], areas[members]
        size = weight.norm(dim=1).clamp_min(1e-30)
        center = (place * size[:, None]).sum(0) / size.sum()
        radius = float((place - center).norm(dim=1).max())
        offset = center - queries
        distance = offset.norm(dim=1)
        near = distance <= _FAR * radius + 1e-30
        one = offset @ weight.sum(0) / (distance**2 + soft**2).clamp_min(1e-30) ** 1.5
        total += torch.where(near, 0.0, one)
        index = near.nonzero()[:, 0]
        for part in index.split(max(1, _CHUNK // len(place))):
            gap = place[None] - queries[part, None]
            cube = (gap.square().sum(-1) + soft**2).clamp_min(1e-30) ** 1.5
            total[part] += (torch.einsum("mnc,nc->mn", gap, weight) / cube).sum(1)
    return total / (4.0 * math.pi)


def _clusters(points: Tensor) -> list[Tensor]:
    """Index sets of at most :data:`_CLUSTER` points, by halving the longest side of their box."""
    place = points.cpu().numpy()
    found, todo = [], [np.arange(len(place))]
    while todo:
        part = todo.pop()
        if len(part) <= _CLUSTER:
            found.append(torch.from_numpy(part).to(points.device))
            continue
        axis = int(np.ptp(place[part], axis=0).argmax())
        order = part[np.argsort(place[part, axis], kind="stable")]
        todo += [order[: len(order) // 2], order[len(order) // 2 :]]
    return found
