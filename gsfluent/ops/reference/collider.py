"""Rigid colliders in plain PyTorch, float64: the definition, for tests.

Distances are written from their geometry and rotations as matrices, not from the kernels.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rotation(quaternion: Tensor) -> Tensor:
    """Rotation matrix [3, 3] of a quaternion w, x, y, z of any length; zero turns nothing."""
    if not bool(quaternion.norm() > 0):
        return torch.eye(3, dtype=quaternion.dtype)
    w, x, y, z = (quaternion / quaternion.norm()).tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=quaternion.dtype)


def _box(p: Tensor, half: Tensor) -> Tensor:
    q = p.abs() - half
    return q.clamp_min(0).norm(dim=-1) + q.amax(dim=-1).clamp_max(0)


def _bar(h: Tensor, q: Tensor) -> Tensor:
    """Two half spaces that meet at right angles: both distances <= 0 is inside."""
    both = torch.stack([h, q], dim=-1)
    return both.clamp_min(0).norm(dim=-1) + both.amax(dim=-1).clamp_max(0)


def _grid(row: Tensor, sdf: Tensor, p: Tensor) -> Tensor:
    size = [int(v) for v in row[26:29]]
    start = 64 * int(row[29])
    values = sdf[start : start + size[0] * size[1] * size[2]].to(p.dtype).view(size)
    last = torch.tensor(size, dtype=p.dtype) - 1
    u = (p - row[6:9]) / row[9]
    inside = torch.minimum(u.clamp_min(0), last)
    base = torch.minimum(inside.detach().floor(), last - 1).long()
    f = inside - base
    total = torch.zeros_like(p[..., 0])
    for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
        w = torch.where(corner.bool(), f, 1 - f).prod(dim=-1)
        total = total + w * values[(base + corner).unbind(-1)]
    gap = ((u - inside) * row[9]).norm(dim=-1)
    return torch.where(gap > 0, torch.maximum(gap, total - gap), total)


def signed_distance(row: Tensor, sdf: Tensor | None, x: Tensor) -> Tensor:
    """Signed distance [m] of points x [..., 3] from one collider row [32]."""
    kind, radius = int(row[0]), row[9]
    p = (x - row[3:6]) @ rotation(row[16:20])
    if kind == 0:
        n = row[6:9] / row[6:9].norm()
        h = p @ n
        return h if radius == 0 else _bar(h, (p - h[..., None] * n).norm(dim=-1) - radius)
    if kind == 1:
        return p.norm(dim=-1) - radius
    if kind == 2:
        return _box(p, row[26:29])
    if kind == 3:
        tip = torch.stack([0 * p[..., 2], 0 * p[..., 2], p[..., 2].clamp(-row[28], row[28])], -1)
        return (p - tip).norm(dim=-1) - radius
    if kind == 4:
        return _bar(p[..., 2].abs() - row[28], p[..., :2].norm(dim=-1) - radius)
    assert sdf is not None
    return _grid(row, sdf, p)


def distance_and_normal(row: Tensor, sdf: Tensor | None, x: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and its gradient by autograd; right wherever the distance is smooth."""
    with torch.enable_grad():
        x = x.detach().requires_grad_(True)
        d = signed_distance(row, sdf, x)
        (slope,) = torch.autograd.grad(d.sum(), x)
    return d.detach(), torch.nn.functional.normalize(slope, dim=-1)


def give(row: Tensor, contact_mass: Tensor) -> Tensor:
    """Share of the velocity change that nodes get from a collider with mass."""
    mass, kind, mode, mu = row[14], int(row[0]), int(row[1]), row[2]
    if not bool(mass > 0):
        return torch.ones_like(mass)
    e, r = row[26:29], row[9]
    ends = [row[6:9], row[6:9] + (e - 1) * r]
    bounds = {
        1: r,
        2: e.norm(),
        3: r + e[2],
        4: torch.hypot(r, e[2]),
        5: torch.maximum(-ends[0], ends[1]).norm(),
    }
    moments = row[23:26][row[23:26] > 0]
    turning = mass * bounds[kind] ** 2 / moments.min() if len(moments) else 0 * mass
    if kind == 1:
        turning = turning * [1.0, 0.0, mu**2 / (1 + mu**2)][mode]
    return 1 / (1 + contact_mass / mass * (1 + turning))


def first_touch(
    row: Tensor, sdf: Tensor | None, x: Tensor, path: Tensor, dx: float
) -> tuple[Tensor, Tensor]:
    """Part of the relative ``path`` before the first touch (2: none) and the normal there.

    By looking at 4000 places along the path: slow and plain.
    """
    at = torch.full_like(x[..., 0], 2.0)
    normal = torch.zeros_like(x)
    for i in range(4001):
        s = i / 4000
        d, n = distance_and_normal(row, sdf, x + s * path)
        hit = (d <= (1e-4 if i == 0 else 1e-3) * dx) & (at > 1)
        at = torch.where(hit, s, at)
        normal = torch.where(hit[..., None], n, normal)
    approaching = (path * normal).sum(-1) < 0
    return torch.where((at > 0) & ~approaching, 2.0, at), normal


def collide(
    row: Tensor,
    sdf: Tensor | None,
    x: Tensor,
    velocity: Tensor,
    mass: Tensor,
    dx: float,
    dt: float,
) -> Tensor:
    """Velocity [K, B, 64, 3] of nodes x [B, 64, 3] of masses [K, B, 64] after one collider."""
    mode, friction, restitution = int(row[1]), row[2], row[13]
    own = row[10:13] + torch.linalg.cross(row[20:23].expand_as(x), x - row[3:6])
    relative = velocity - own
    if bool(row[15] != 0):
        where = x.expand_as(velocity)
        before, n = first_touch(row, sdf, where, dt * relative, dx)
        share = torch.where(before <= 1, 1 - before, 0.0)[..., None]
    else:
        d, n = distance_and_normal(row, sdf, x)
        share = (d <= 1e-4 * dx).to(x.dtype)[..., None]
    vn = (relative * n).sum(-1, keepdim=True)
    slip = relative - vn * n
    if mode == 0:
        after = own.expand_as(velocity)
    elif mode == 1:
        after = own + slip
    else:
        speed = slip.norm(dim=-1, keepdim=True)
        kept = (speed + friction * (1 + restitution) * vn).clamp_min(0)
        bounced = own + kept * slip / speed.clamp_min(1e-300) - restitution * vn * n
        after = torch.where(vn < 0, bounced, velocity)
    heavy = mass > 1e-30
    touching = (mass * (heavy & (share[..., 0] > 0))).sum()
    changed = velocity + share * give(row, touching) * (after - velocity)
    return torch.where(heavy[..., None], changed, velocity)
