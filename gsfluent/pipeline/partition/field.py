"""A label's share of what is around a voxel, kept in the box where it has one."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Field(NamedTuple):
    """A label's share of its surroundings in its box of the grid; 0.5 at a face.

    Attributes:
        low: First voxel of the box.
        share: [x, y, z].
    """

    low: tuple[int, int, int]
    share: Tensor

    @property
    def span(self) -> tuple[slice, slice, slice]:
        """The box as slices of the grid."""
        x, y, z = (slice(a, a + n) for a, n in zip(self.low, self.share.shape, strict=True))
        return x, y, z


Box = list[tuple[int, int]]
"""First and last index along each axis."""


def boxes(labels: Tensor, count: int) -> list[Box | None]:
    """The box of every label, of voxels [X, Y, Z]; None for those without a voxel."""
    where = (labels >= 0).nonzero()
    label = labels[where[:, 0], where[:, 1], where[:, 2]].long()
    ends = []
    for axis in range(3):
        size = labels.shape[axis]
        line = torch.bincount(label * size + where[:, axis], minlength=count * size)
        there = line.view(count, size) > 0
        steps = torch.arange(size, device=labels.device)
        low = torch.where(there, steps, size).amin(dim=1)
        high = torch.where(there, steps, -1).amax(dim=1)
        ends.append(torch.stack([low, high], dim=1).tolist())
    found = [[(a, b) for a, b in (axis[n] for axis in ends)] for n in range(count)]
    return [box if box[0][1] >= 0 else None for box in found]


def grown(box: Box, margin: int) -> tuple[tuple[int, int, int], tuple[slice, slice, slice]]:
    """First voxel and slices of a box with a margin, within the grid's beginning."""
    (a, i), (b, j), (c, k) = box
    low = max(0, a - margin), max(0, b - margin), max(0, c - margin)
    x, y, z = (slice(s, e + 1 + margin) for s, e in zip(low, (i, j, k), strict=True))
    return low, (x, y, z)
