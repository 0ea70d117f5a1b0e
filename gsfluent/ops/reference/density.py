"""``occupancy`` and ``density_normals`` in plain PyTorch: what the kernels are tested against."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, conv3d, grid_sample, normalize

LEVELS = 5
# Binomial smoothing before the gradient, in passes of [1, 2, 1] / 4 (counts scatter), and of the
# wide look, which stands on this level and counts when it is this clear.
PASSES = 4
WIDE_PASSES = 1
WIDE = 2
CLEAR = 0.1
# Half the gradient up to which a sheet does not say which way its splats lie.
UNCLEAR = 0.05
# Gradient from which the density leads, and the share of a flat splat's own axis then.
SURE = 0.12
OWN = 0.5
# Cosine to the eye below which a vector is seen from its other side.
AWAY = -0.25
# A splat is called flat when its shortest axis is below this share of the middle one.
FLAT = 0.5


def occupancy(means: Tensor, frame: Tensor, nodes: int, *, full: float) -> Tensor:
    """See ``gsfluent.ops``; ``means`` must be finite."""
    place = (means - frame[:3]) / frame[3] - 0.5
    base = place.floor()
    part = place - base
    inside = ((base >= 0) & (base < nodes - 1)).all(-1)
    base, part = base[inside].long(), part[inside]
    first = (base[:, 2] * nodes + base[:, 1]) * nodes + base[:, 0]
    count = torch.zeros(nodes**3, dtype=means.dtype, device=means.device)
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
        weight = torch.ones_like(part[:, 0])
        for axis, high in enumerate((x, y, z)):
            weight = weight * (part[:, axis] if high else 1.0 - part[:, axis])
        count.index_add_(0, first + (z * nodes + y) * nodes + x, weight)
    levels = [(count / full).clamp(max=1.0).view(1, 1, nodes, nodes, nodes)]
    for _ in range(LEVELS - 1):
        levels.append(avg_pool3d(levels[-1], 2))
    return torch.cat([level.flatten() for level in levels])


def level_of(values: Tensor, nodes: int, level: int) -> Tensor:
    """One level of the pyramid, [D, D, D]."""
    start = sum((nodes >> k) ** 3 for k in range(level))
    side = nodes >> level
    return values[start : start + side**3].view(side, side, side)


def gradient(volume: Tensor, passes: int) -> Tensor:
    """Gradient per cell [3, D, D, D] in x, y, z of a volume (z, y, x), smoothed before."""
    row = [math.comb(2 * passes, k) / 4.0**passes for k in range(2 * passes + 1)]
    weights = torch.tensor(row, dtype=volume.dtype, device=volume.device)
    volume = volume[None, None]
    for axis in range(3):
        shape, pad = [1, 1, 1, 1, 1], [0, 0, 0]
        shape[2 + axis], pad[axis] = 2 * passes + 1, passes
        volume = conv3d(volume, weights.view(shape), padding=pad)
    slope = torch.zeros(3, 1, 3, 3, 3, dtype=volume.dtype, device=volume.device)
    slope[0, 0, 1, 1, 0] = slope[1, 0, 1, 0, 1] = slope[2, 0, 0, 1, 1] = -0.5
    slope[0, 0, 1, 1, 2] = slope[1, 0, 1, 2, 1] = slope[2, 0, 2, 1, 1] = 0.5
    return conv3d(volume, slope, padding=1)[0]


def sample(volume: Tensor, frame: Tensor, nodes: int, points: Tensor) -> Tensor:
    """Trilinear values [N, C] of a volume [C, D, D, D] of any level at points; 0 outside."""
    place = (points - frame[:3]) * (2.0 / (frame[3] * nodes)) - 1.0
    found = grid_sample(
        volume[None],
        place.reshape(1, 1, 1, -1, 3),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    )
    return found.reshape(volume.shape[0], -1).T


def density_normals(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    values: Tensor,
    frame: Tensor,
    nodes: int,
    *,
    eye: Tensor | None = None,
) -> Tensor:
    """See ``gsfluent.ops``."""
    fine = -sample(gradient(level_of(values, nodes, 0), PASSES), frame, nodes, means)
    wide = -sample(gradient(level_of(values, nodes, WIDE), WIDE_PASSES), frame, nodes, means)
    against = ((fine * wide).sum(-1) < 0) & (wide.norm(dim=-1) > CLEAR)
    outward = torch.where(against[:, None], -fine, fine)
    unit = normalize(quats, dim=-1)
    shortest, index = scales.min(dim=-1)
    middle = scales.sum(-1) - shortest - scales.amax(-1)
    along = torch.nn.functional.one_hot(index, 3).to(scales)
    w, vector = unit[:, :1], unit[:, 1:]
    once = torch.linalg.cross(vector, along)
    axis = along + 2.0 * (w * once + torch.linalg.cross(vector, once))
    agreement = (axis * outward).sum(-1)
    clear = outward.norm(dim=-1)
    flat = shortest < FLAT * middle
    own = axis * torch.where(agreement < 0, -1.0, 1.0).to(axis)[:, None]
    led = normalize(normalize(outward, dim=-1) + OWN * own, dim=-1)
    sure = clear > SURE
    alone = flat & ~sure & (agreement.abs() > 0.5 * clear - UNCLEAR)
    outward = torch.where((flat & sure)[:, None], led, outward)
    outward = torch.where(alone[:, None], own, outward)
    if eye is None:
        return outward
    # what both gradients are sure of is seen from behind where it sticks out over an outline
    sure = ((outward * wide).sum(-1) > 0) & (wide.norm(dim=-1) > CLEAR)
    sure &= outward.norm(dim=-1) > SURE
    view = eye - means
    least = AWAY * outward.norm(dim=-1) * view.norm(dim=-1)
    return torch.where((~sure & ((outward * view).sum(-1) < least))[:, None], -outward, outward)
