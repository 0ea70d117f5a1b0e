"""What splits of a partition have done: labels and distances around the new faces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.pipeline.partition.threshold import Labels


class Split(NamedTuple):
    """How one region was divided.

    Attributes:
        low: First voxel of the box that was touched.
        ids: Regions, by the labels below: the old one, then the new ones.
        labels: Labels in the box and the next ones, -1 outside of the region.
        face: Distance from the nearest face, about [m], at most
            :data:`~gsfluent.pipeline.partition.threshold.FAR` blurs, [X, Y, Z].
        error: How far volumes are off, as shares of themselves, float64 [F].
    """

    low: tuple[int, int, int]
    ids: tuple[int, ...]
    labels: Labels
    face: Tensor
    error: Tensor

    def numbers(self) -> Split:
        """The same without what is known of voxels, 12 bytes for each of the box."""
        none = self.face.new_empty((0, 0, 0))
        first, second = (part.new_empty((0, 0, 0)) for part in self.labels[:2])
        return self._replace(labels=Labels(first, second, none), face=none)


class Splits:
    """Several splits of one partition, looked at together: a look at all costs what one does.

    Places are voxels of the body's grid; each is asked of one split.

    Args:
        splits: At least one.

    Attributes:
        each: They.
    """

    def __init__(self, splits: Sequence[Split]) -> None:
        self.each = splits
        device = splits[0].face.device
        shapes = [split.face.shape for split in splits]
        starts, known, end, names = [], [], 0, 0
        for split, shape in zip(splits, shapes, strict=True):
            starts.append(end)
            known.append(names)
            end, names = end + math.prod(shape), names + len(split.ids)
        table = [
            (*split.low, *shape, start, first)
            for split, shape, start, first in zip(splits, shapes, starts, known, strict=True)
        ]
        self._table = torch.tensor(table, dtype=torch.int64, device=device)
        ids = [number for split in splits for number in split.ids]
        self._ids = torch.tensor(ids, dtype=torch.int64, device=device)
        self._first = _joined([split.labels.first for split in splits])
        self._second = _joined([split.labels.second for split in splits])
        self._face = _joined([split.face for split in splits])

    def region(self, of: Tensor, label: Tensor) -> Tensor:
        """Regions of labels, int64 [M]; ``of``: number of the split of each, int64 [M]."""
        return self._ids[self._table[of, 7] + label]

    def _flat(self, of: Tensor, voxel: Tensor) -> tuple[Tensor, Tensor]:
        """Whether voxels are in the boxes, and rows of them or of the nearest ones that are."""
        low, size, start = self._table[of].split([3, 3, 2], dim=-1)
        local = voxel - low
        held = torch.minimum(local.clamp(min=0), size - 1)
        flat = (held[..., 0] * size[..., 1] + held[..., 1]) * size[..., 2] + held[..., 2]
        return (local == held).all(dim=-1), start[..., 0] + flat

    def labels(self, of: Tensor, voxel: Tensor) -> tuple[Tensor, Tensor]:
        """Labels of voxels and the next ones, int64; -1 where they lie in no piece of the split.

        Args:
            of: Number of the split of each, int64 [M].
            voxel: int64 [M, 3].
        """
        here, flat = self._flat(of, voxel)
        first, second = self._first[flat].long(), self._second[flat].long()
        return torch.where(here, first, -1), torch.where(here, second, -1)

    def signed(self, of: Tensor, label: Tensor, voxel: Tensor) -> Tensor:
        """Distance from a label's face [m], positive inside; nan outside of the split's region.

        Args:
            of: Number of the split, int64 [...].
            label: int64 [...].
            voxel: int64 [..., 3].
        """
        here, flat = self._flat(of, voxel)
        first, second = self._first[flat].long(), self._second[flat].long()
        far = self._face[flat]
        value = torch.where(first == label, far, -far)
        # neither the first nor the second: deeper in foreign matter than that
        value = torch.where((first != label) & (second != label), -2.0 * far, value)
        return torch.where(here & (first >= 0), value, torch.nan)

    def slope(self, of: Tensor, label: Tensor, voxel: Tensor, edge: float) -> tuple[Tensor, Tensor]:
        """:meth:`signed` [M] at voxels [M, 3] of the edge ``edge`` [m], and its gradient [M, 3]."""
        one = torch.eye(3, dtype=torch.int64, device=voxel.device)
        steps = torch.cat([torch.zeros_like(one[:1]), one, -one])  # a look at all costs less
        around = self.signed(of, label, voxel + steps[:, None])
        here, lone = around[0], around.isnan()
        ahead, behind = torch.where(lone, here, around)[1:].view(2, 3, -1)
        lone = lone[1:4] | lone[4:]
        return here, ((ahead - behind) / torch.where(lone, edge, 2.0 * edge)).T.contiguous()


def _joined(parts: list[Tensor]) -> Tensor:
    """Their values, one after another."""
    return parts[0].reshape(-1) if len(parts) == 1 else torch.cat([p.reshape(-1) for p in parts])
