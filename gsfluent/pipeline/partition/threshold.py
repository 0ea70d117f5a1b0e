"""Smooth partition of voxels by labelled points: threshold dynamics with volumes kept.

The label of the nearest point makes faces as rough as the lattice of the points. So each label's
indicator is blurred, the largest wins, and what has won is blurred once more (Merriman, Bence and
Osher 1992; Esedoglu and Otto 2015): the differences of the results are smooth functions whose zero
sets are the faces. Constants added to them keep the volumes (Ruuth and Wetton 2003).

Blurs count whole numbers and labels go by size and place, so that neither the order of the points
nor the device matters.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.matter.fragments import components
from gsfluent.pipeline.partition.blur import blur, box_width, reach
from gsfluent.pipeline.partition.chips import chip_fields
from gsfluent.pipeline.partition.field import Field, Shares, boxes, grown
from gsfluent.pipeline.partition.roughness import displacements

STAMP = 1.45
"""Point spacings from a point to the voxels that it can name (:func:`gsfluent.ops.nearest_labels`).
"""
FIRST, SECOND = 1.2, 0.8
"""Standard deviations of the blurs of pieces, in point spacings."""
DUST_BLUR = 0.4
"""The same of dust, a point of which is not to be blurred away."""
DUST_GAIN = 1.4
"""By so much shares of dust are larger: the cell of one point, blurred, has one of half."""
CHIP = 64
"""Points from which on a label is a piece."""
ISLAND = 27
"""Voxels below which a lump joins what is around it."""
VOLUME = 0.01
"""Error of a volume that is good enough."""
_CLEAR = 0.95  # difference of two shares from which on no displacement changes the label
_PASSES = 60
FAR = 3.5
"""Standard deviations of the second blur at which the distance from a face is capped."""


class Labels(NamedTuple):
    """Labels of voxels.

    Attributes:
        first: Label of each voxel, -1 outside of the domain, int16 [X, Y, Z].
        second: The label that is next there, -1 for none, int16 [X, Y, Z].
        lead: By how much the first leads, 0 to 1, float32 [X, Y, Z].
    """

    first: Tensor
    second: Tensor
    lead: Tensor


def fields(nearest: Tensor, small: list[bool], per_spacing: float, dust: int = -1) -> Shares:
    """Shares of every label: pieces by threshold dynamics, chips between planes.

    Pieces are smoothed as if there were no chips and no dust, which are then cut out of them.

    Args:
        nearest: Label of each voxel, -1 outside of the domain, int16 [X, Y, Z].
        small: Which labels are chips.
        per_spacing: Voxels per point spacing.
        dust: The label that is dust: the cells of single points; -1 for none.

    Returns:
        One field for each label; of no size where it has no voxel.
    """
    inside, count = nearest >= 0, len(small)
    chips = [label for label, chip in enumerate(small) if chip and label != dust]
    made = chip_fields(nearest, chips, boxes(nearest, count), per_spacing)
    large, others = nearest, [*chips, dust] if dust >= 0 else chips
    if others:
        table = torch.arange(-1, count, dtype=torch.int16, device=nearest.device)
        table[torch.tensor(others, device=nearest.device) + 1] = -1
        large = table[nearest.long() + 1]

    def shares(labels: Tensor, among: Tensor, sigma: float) -> Iterator[tuple[int, Field]]:
        width = box_width(sigma * per_spacing)
        sums = blur(among, width).to(torch.float32).clamp_(min=1.0)
        for label, box in enumerate(boxes(labels, count)):
            if box is not None:
                low, span = grown(box, reach(width))
                part = blur(labels[span] == label, width).to(torch.float32)
                yield label, Field(low, part / sums[span])

    if dust >= 0:
        only = torch.where(nearest == dust, nearest, -1)
        for label, field in shares(only, inside, DUST_BLUR):
            made[label] = Field(field.low, DUST_GAIN * field.share)
    won = torch.full_like(nearest, -1)
    best = torch.zeros(nearest.shape, device=nearest.device)
    for label, field in shares(large, large >= 0, FIRST):
        span = field.span
        more = inside[span] & (field.share > best[span])
        best[span] = torch.where(more, field.share, best[span])
        won[span] = won[span].masked_fill(more, label)
    # a voxel that no blur reached keeps its own
    won = torch.where(inside & (won < 0), large, won)
    left = torch.ones_like(best)
    for field in made.values():
        left[field.span] = torch.minimum(left[field.span], 1.0 - field.share)
    left.clamp_(min=0.0)
    found: list[Field | None] = [made.get(label) for label in range(count)]
    for label, field in shares(won, inside, SECOND):
        found[label] = Field(field.low, field.share * left[field.span])
    return Shares.of(found, nearest.device)


def top_two(shape: tuple[int, ...], found: Shares, inside: Tensor) -> Labels:
    """The two largest of the fields at every voxel."""
    first, second, lead = ops.largest_shares(None, shape, found.shares, found.box)
    return Labels(torch.where(inside, first, -1), torch.where(inside, second, -1), lead)


def displaced(
    smooth: Labels, found: Shares, low: tuple[int, int, int], amplitude: float
) -> tuple[Tensor, Labels]:
    """The two largest fields at displaced places, for voxels near a face.

    Args:
        smooth: From :func:`top_two`.
        found: The fields.
        low: Index of the first voxel, by which the displacements go.
        amplitude: Rms displacement along each axis [voxels].

    Returns:
        Voxels near a face, int64 [M, 3], and their labels, each [M].
    """
    near = ((smooth.second >= 0) & (smooth.lead < _CLEAR)).nonzero()
    shift = displacements(near + torch.tensor(low, device=near.device))
    place = near.to(torch.float32) + shift * amplitude
    first, second, lead = ops.largest_shares(place, smooth.first.shape, found.shares, found.box)
    # displaced out of every field: what it was
    old = [part[near[:, 0], near[:, 1], near[:, 2]] for part in smooth]
    lost = first < 0
    first, second = torch.where(lost, old[0], first), torch.where(lost, old[1], second)
    return near, Labels(first, second, torch.where(lost, old[2], lead))


def keep_volumes(
    labels: Labels, counted: Tensor, fixed: Tensor, wanted: Tensor
) -> tuple[Labels, Tensor]:
    """Add constants to the fields until every label has its volume.

    Args:
        labels: Of the voxels near a face, each [M].
        counted: Which of them count, bool [M].
        fixed: Voxels of every label that are far from any face, int64 [F].
        wanted: Volumes [voxels], float64 [F].

    Returns:
        The labels, and how far the volumes are off [voxels], float64 [F].
    """
    count = wanted.shape[0]
    first, second = labels.first.long(), labels.second.long()
    pair = counted & (second >= 0)
    a, b, lead = first[pair], second[pair], labels.lead[pair]
    alone = torch.bincount(first[counted & (second < 0)], minlength=count) + fixed
    alone = alone.to(torch.float64).cpu()
    offset = torch.zeros(count, dtype=torch.float64)
    wanted = wanted.cpu()
    bar = torch.clamp(0.5 * VOLUME * wanted, min=1.0)
    width, best = 0.2, (math.inf, offset)
    gain, last = torch.full_like(offset, 0.6), torch.zeros_like(offset)
    for _ in range(_PASSES):
        counts = ops.margin_counts(lead, a, b, offset.to(lead.device), width)
        volume, near = counts.cpu()
        error = alone + volume - wanted
        worst = float((error.abs() / bar).amax())
        if worst < best[0]:
            best = worst, offset.clone()
        if worst <= 1.0:
            break
        # by how much a volume grows with its constant: voxels within a band about the faces
        slope = (near.to(torch.float64) / (2.0 * width)).clamp(min=1.0)
        # where the error has changed sign the step was too long
        gain = torch.where(error * last < 0.0, 0.6 * gain, (1.1 * gain).clamp(max=0.6))
        last = error
        offset = (offset - (gain * error / slope).clamp(-0.1, 0.1)).clamp(-0.9, 0.9)
        width = max(0.05, 0.9 * width)
    now = _margin(labels.lead, best[1], first, second.clamp(min=0))
    swap = (second >= 0) & (now < 0)
    changed = Labels(
        torch.where(swap, labels.second, labels.first),
        torch.where(swap, labels.first, labels.second),
        torch.where(second >= 0, now.abs().to(torch.float32), labels.lead),
    )
    mine = torch.where(swap, second, first)[counted]
    volume = (torch.bincount(mine, minlength=count) + fixed).cpu().to(torch.float64)
    return changed, volume - wanted


def _margin(lead: Tensor, offset: Tensor, a: Tensor, b: Tensor) -> Tensor:
    constant = offset.to(lead.device)
    return lead.double() + (constant[a] - constant[b])


def join_islands(labels: Labels, near: Tensor, dust: int = -1) -> Labels:
    """Give lumps of less than 27 voxels the label that touches most of their faces.

    Args:
        labels: Of all voxels, each [X, Y, Z].
        near: Voxels near a face, int64 [M, 3]; nothing else can be an island.
        dust: A label that may have islands; -1 for none.
    """
    first = labels.first
    shape, device, count = first.shape, first.device, near.shape[0]
    if count == 0:
        return labels
    row = torch.full((math.prod(shape),), -1, dtype=torch.int32, device=device)
    flat = (near[:, 0] * shape[1] + near[:, 1]) * shape[2] + near[:, 2]
    row[flat] = torch.arange(count, dtype=torch.int32, device=device)
    values = first.reshape(-1)
    own = values[flat].long()
    # all six sides of all voxels at once, those of higher numbers first
    sides = torch.cat([torch.eye(3), -torch.eye(3)]).to(device, torch.int64)
    at = near + sides[:, None]
    there = ((at >= 0) & (at < torch.tensor(shape, device=device))).all(dim=2)
    strides = torch.tensor([shape[1] * shape[2], shape[2], 1], device=device)
    beside = torch.where(there, flat + (sides * strides).sum(dim=1)[:, None], 0)
    other, link = values[beside].long(), row[beside].long()
    same = there & (other == own)
    rooted = (same & (link < 0)).any(dim=0)
    axis, joined = (same & (link >= 0))[:3].nonzero().unbind(dim=1)
    root = components(joined, link[axis, joined], count)
    size = torch.bincount(root, minlength=count)
    safe = torch.zeros(count, dtype=torch.int64, device=device).index_add(0, root, rooted.long())
    many = int(values.max()) + 1
    whole = torch.bincount(values[values >= 0].long(), minlength=many)
    island = ((size < ISLAND) & (safe == 0))[root] & (own >= 0)
    island &= size[root] < whole[own.clamp(min=0)]  # what is all of its label stays
    if dust >= 0:
        island &= own != dust
    if not bool(island.any()):
        return labels
    side, rows = (there & ~same & (other >= 0) & island).nonzero().unbind(dim=1)
    lump, slot = torch.unique(root[island], return_inverse=True)
    lumps = torch.searchsorted(lump, root[rows])
    faces = torch.bincount(lumps * many + other[side, rows], minlength=len(lump) * many)
    faces = faces.view(len(lump), many)
    most = faces.amax(dim=1, keepdim=True)
    # of what touches as many, the lowest
    around = torch.where(faces == most, torch.arange(many, device=device), many).amin(dim=1)
    change = island.clone()
    change[island] = most[slot, 0] > 0
    around = around[slot[most[slot, 0] > 0]]
    where = flat[change]
    parts = [part.clone().reshape(-1) for part in labels]
    parts[1][where] = parts[0][where]
    parts[0][where] = around.to(torch.int16)
    parts[2][where] = 1e-3
    return Labels(*(part.view(shape) for part in parts))
