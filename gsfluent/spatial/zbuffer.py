"""Points as opaque discs in a z-buffer: which point a camera sees in each pixel.

For matter rather than for pictures: silhouettes without soft rims, depths and motions without
blending, from the material points themselves.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.data import Camera

_AT_ONCE = {"cpu": 1 << 18}  # pixels of points looked at in one go: as the cache is
_AT_ONCE_ELSEWHERE = 1 << 22  # where launches cost more than memory
LARGEST = 24.0
"""Discs are drawn no larger than this radius [px], which bounds the time for points very near."""


def nearest_points(points: Tensor, radius: Tensor | float, camera: Camera) -> Tensor:
    """Row of the nearest point per pixel.

    A point covers the pixels whose centres lie within its projected radius; one that is smaller
    than a pixel covers at least the pixel its centre falls into.

    Args:
        points: Points [m], [N, 3].
        radius: Radii [m], [N] or one for all.
        camera: Pinhole camera.

    Returns:
        int64 [H, W], -1 where there is none.
    """
    width, height = camera.width, camera.height
    viewmat, intrinsics = camera.viewmat.to(points), camera.K.to(points)
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[:, 2].clamp(min=1e-9)
    u = intrinsics[0, 0] * local[:, 0] / z + intrinsics[0, 2]
    v = intrinsics[1, 1] * local[:, 1] / z + intrinsics[1, 2]
    reach = (intrinsics[0, 0] * torch.as_tensor(radius).to(points) / z).clamp(max=LARGEST)
    near = (local[:, 2] > 1e-6) & torch.isfinite(u + v)
    near &= (u > -reach) & (v > -reach) & (u < width + reach) & (v < height + reach)
    rows = near.nonzero()[:, 0]
    best = torch.full((height * width,), torch.iinfo(torch.int64).max, device=points.device)
    if rows.numel():
        u, v, reach = u[rows], v[rows], reach[rows]
        # positive floats are ordered like the integers of the same bits
        key = (z[rows].float().contiguous().view(torch.int32).long() << 32) | rows
        column, line = u.floor(), v.floor()
        most = math.ceil(float(reach.amax()) - 0.5)
        most_at_once = _AT_ONCE.get(points.device.type, _AT_ONCE_ELSEWHERE)
        side = torch.arange(-most, most + 1, device=points.device)
        steps = torch.cartesian_prod(side, side)
        for part in steps.split(max(1, most_at_once // rows.numel())):
            dx, dy = part.to(u).T[..., None]
            x, y = column + dx, line + dy
            inside = (x + 0.5 - u).square() + (y + 0.5 - v).square() <= reach.square()
            inside |= (part == 0).all(dim=1)[:, None]
            inside &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
            pixel = (y * width + x)[inside].long()
            best.scatter_reduce_(0, pixel, key.expand_as(inside)[inside], "amin")
    empty = best == torch.iinfo(torch.int64).max
    return torch.where(empty, -1, best & 0xFFFFFFFF).view(height, width)
