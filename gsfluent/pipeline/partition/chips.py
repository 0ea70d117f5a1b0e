"""The shape of chips: crumbs between planes.

A chip is a few points large, so that any blur makes a ball of it. What breaks off is angular. So a
chip is what lies between planes around the voxels of its points: the sides of a box and up to four
of its corners, turned and shifted by a hash of its place, then stretched as the points lie (by
their second moments), so that flat chips stay flat and long ones long, and scaled until it has the
volume of its points. All chips are different, and the same on every device.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.partition.field import Box, Field, Span, grown

UNEVEN = 0.45
"""By how much of its distance from the middle a plane is moved in or out, at most."""
FLAT = 0.3
"""By how much of it two opposite ones are."""
TILT = 0.35
"""By how much normals are tilted, as the tangent along each axis, at most."""
LEAST = 1e-3
"""Share of a chip in the voxels that are its points': it is never nothing there."""
_CORNER = 3.0**-0.5
_PLANES = (
    (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0),
    (_CORNER, _CORNER, _CORNER), (_CORNER, -_CORNER, -_CORNER),
    (-_CORNER, _CORNER, -_CORNER), (-_CORNER, -_CORNER, _CORNER),
)  # fmt: skip
_SIDES, _AWAY = 6, 3.0
_MASK = 0xFFFFFFFF
_AT_ONCE = (1 << 18, 1 << 22)  # voxels, on the CPU and elsewhere


def chip_fields(
    nearest: Tensor, chips: list[int], box_of: list[Box | None], per_spacing: float
) -> dict[int, Field]:
    """Shares of chips: 0.5 on their planes, one more for every two point spacings inward.

    Args:
        nearest: Label of each voxel, -1 outside of the domain, int16 [X, Y, Z].
        chips: Labels that are chips.
        box_of: Boxes of all labels; those without one have no field.
        per_spacing: Voxels per point spacing.
    """
    there = [label for label in chips if box_of[label] is not None]
    if not there:
        return {}
    planes = _planes(nearest, there)
    margin = max(1, round(2.0 * per_spacing))
    spans: dict[int, Span] = {}
    for label in there:
        box = box_of[label]
        assert box is not None  # there has no other
        spans[label] = grown(box, margin)
    found: dict[int, Field] = {}
    slots, voxels = [], 0
    for slot, label in enumerate(there):
        slots.append(slot)
        voxels += math.prod(nearest[spans[label][1]].shape)
        if voxels >= _AT_ONCE[nearest.device.type != "cpu"] or slot + 1 == len(there):
            some = [there[n] for n in slots]
            parts = _between(nearest, some, [spans[n] for n in some], planes, slots, per_spacing)
            found.update(zip(some, parts, strict=True))
            slots, voxels = [], 0
    return found


def _between(
    nearest: Tensor,
    labels: list[int],
    spans: list[Span],
    planes: tuple[Tensor, Tensor, Tensor],
    slots: list[int],
    per_spacing: float,
) -> list[Field]:
    """What lies between the planes of some chips, the voxels of all in one row."""
    device = nearest.device
    boxes = [nearest[span] for _, span in spans]
    count = [box.numel() for box in boxes]
    owner = torch.repeat_interleave(torch.tensor(count, device=device))
    row = torch.tensor(slots, device=device)[owner]
    normals = planes[1]
    middle, reach = planes[0][row], planes[2][row]
    first = torch.tensor([0, *itertools.accumulate(count)][:-1], device=device)
    within = torch.arange(sum(count), device=device) - first[owner]
    low = torch.tensor([low for low, _ in spans], device=device)[owner]
    _, m, n = torch.tensor([box.shape for box in boxes], device=device)[owner].unbind(dim=1)
    place = torch.stack([within // (m * n), within // n % m, within % n], dim=1) + low
    # distances from the middle along the normals of all planes, one product and one sum at a time
    away = place.double() - middle
    x, y, z = (away[:, axis, None] * normals[..., axis][row] for axis in range(3))
    out = (x + y) + z
    gauge = (out / reach).amax(dim=1)
    label = torch.cat([box.reshape(-1) for box in boxes])
    mine = label == torch.tensor(labels, device=device)[owner]
    many = torch.bincount(owner[mine], minlength=len(labels)).tolist()
    gauge = torch.where(label >= 0, gauge, torch.inf)
    size = torch.stack(
        [part.kthvalue(k).values for part, k in zip(gauge.split(count), many, strict=True)]
    )[owner]
    sheet = (size[:, None] * reach - out).amin(dim=1)
    share = (0.5 + sheet / (2.0 * per_spacing)).clamp(min=0.0).to(torch.float32)
    share = torch.where(mine, share.clamp(min=LEAST), share)
    return [
        Field(low, part.view(box.shape))
        for (low, _), part, box in zip(spans, share.split(count), boxes, strict=True)
    ]


def _planes(nearest: Tensor, chips: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Middles [F, 3], unit normals [F, 10, 3] and distances [F, 10] of their planes [voxels].

    One operation at a time on whole sums, which rounds alike everywhere.
    """
    device = nearest.device
    slot = torch.full((int(nearest.max()) + 2,), -1, dtype=torch.int64, device=device)
    slot[torch.tensor(chips, device=device)] = torch.arange(len(chips), device=device)
    where = (slot[nearest.long()] >= 0).nonzero()
    mine = slot[nearest[where[:, 0], where[:, 1], where[:, 2]].long()]
    count = torch.bincount(mine, minlength=len(chips))
    total = torch.zeros(len(chips), 3, dtype=torch.int64, device=device)
    total.index_add_(0, mine, where)
    square = torch.zeros(len(chips), 3, 3, dtype=torch.int64, device=device)
    square.index_add_(0, mine, where[:, :, None] * where[:, None])
    many = count.double()[:, None]
    middle = total.double() / many
    spread = square.double() / many[..., None] - middle[:, :, None] * middle[:, None]
    seed = (total[:, 0] * 0x8DA6B343) ^ (total[:, 1] * 0xD8163841) ^ (total[:, 2] * 0xCB1AB31F)
    seed = (seed ^ (count * 0x9E3779B1)) & _MASK
    turn = _turns(ops.hashes(seed, range(4)))
    base = torch.tensor(_PLANES, dtype=torch.float64, device=device)
    parts = []
    for axis in range(3):  # turned, one product at a time
        row = turn[:, axis, :, None] * base.T
        parts.append(row[:, 0] + row[:, 1] + row[:, 2])
    normal = torch.stack(parts, dim=2)
    planes = len(_PLANES)
    tilt = ops.hashes(seed, range(8, 8 + 3 * planes)).view(-1, planes, 3)
    normal = normal + TILT * tilt
    x, y, z = normal.unbind(dim=2)
    normal = normal / (x * x + y * y + z * z).sqrt()[..., None]
    normal = _stretched(normal, spread)
    x, y, z = normal.unbind(dim=2)
    length = (x * x + y * y + z * z).sqrt()
    normal, reach = normal / length[..., None], 1.0 / length
    shift = ops.hashes(seed, range(64, 64 + planes))
    # half of the corners are not cut
    corner = torch.arange(planes, device=device) >= _SIDES
    far = corner & (ops.hashes(seed, range(96, 96 + planes)) < 0.0)
    # opposite sides go out together: some boxes are slabs, some are rods
    wide = 1.0 + FLAT * ops.hashes(seed, [112 + min(p, _SIDES) // 2 for p in range(planes)])
    return middle, normal, reach * torch.where(far, _AWAY, wide * (1.0 + UNEVEN * shift))


def _stretched(normal: Tensor, spread: Tensor) -> Tensor:
    """Normals [F, K, 3] of planes when what lies between them has these second moments [F, 3, 3].

    With ``S = L L^T`` (Cholesky) places are stretched by L, and normals by the inverse of its
    transpose.
    """
    s = spread + torch.eye(3, dtype=spread.dtype, device=spread.device) / 12.0  # of one voxel
    a = s[:, 0, 0].sqrt()
    b, d = s[:, 1, 0] / a, s[:, 2, 0] / a
    c = (s[:, 1, 1] - b * b).sqrt()
    e = (s[:, 2, 1] - d * b) / c
    f = (s[:, 2, 2] - d * d - e * e).sqrt()
    x, y, z = normal.unbind(dim=2)
    z = z / f[:, None]
    y = (y - e[:, None] * z) / c[:, None]
    x = (x - b[:, None] * y - d[:, None] * z) / a[:, None]
    return torch.stack([x, y, z], dim=2)


def hashed(seed: Tensor, turn: int) -> Tensor:
    """One of :func:`gsfluent.ops.hashes`, of the shape of ``seed``."""
    return ops.hashes(seed, [turn])[..., 0]


def _turns(four: Tensor) -> Tensor:
    """Rotations [F, 3, 3] of quaternions [F, 4] of any length but none."""
    w, x, y, z = four.unbind(dim=1)
    w = torch.where(w.abs() < 1e-3, 1.0, w)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    rows = [
        1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).view(-1, 3, 3)
