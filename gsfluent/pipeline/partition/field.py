"""A label's share of what is around a voxel, kept in the box where it has one."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops


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


class Shares(NamedTuple):
    """Fields as :func:`gsfluent.ops.largest_shares` takes them.

    Attributes:
        shares: Of all fields, one after the other, float32 [S].
        box: First voxel, size and beginning of each, int64 [F, 7].
    """

    shares: Tensor
    box: Tensor

    @classmethod
    def of(cls, fields: list[Field | None], device: torch.device) -> Shares:
        """Fields by label; those that are none have no size."""
        rows, start = [], 0
        for field in fields:
            size = (0, 0, 0) if field is None else tuple(field.share.shape)
            rows.append((*(field.low if field else size), *size, start))
            start += math.prod(size)
        parts = [field.share.reshape(-1) for field in fields if field is not None]
        shares = torch.cat(parts) if parts else torch.zeros(0, device=device)
        box = torch.tensor(rows, dtype=torch.int64).reshape(-1, 7)
        return cls(shares, box.to(device))


Box = list[tuple[int, int]]
"""First and last index along each axis."""
Span = tuple[tuple[int, int, int], tuple[slice, slice, slice]]
"""First voxel of a box, and the box as slices of the grid."""


def boxes(labels: Tensor, count: int) -> list[Box | None]:
    """The box of every label, of voxels [X, Y, Z]; None for those without a voxel."""
    # one look for all: each waits for a GPU
    ends = ops.label_boxes(labels, count).tolist()
    found = [[(a, i), (b, j), (c, k)] for a, i, b, j, c, k in ends]
    return [box if box[0][1] >= 0 else None for box in found]


def grown(box: Box, margin: int) -> Span:
    """First voxel and slices of a box with a margin, within the grid's beginning."""
    (a, i), (b, j), (c, k) = box
    low = max(0, a - margin), max(0, b - margin), max(0, c - margin)
    x, y, z = (slice(s, e + 1 + margin) for s, e in zip(low, (i, j, k), strict=True))
    return low, (x, y, z)
