"""Rigid colliders in plain PyTorch, float64: the definition, for tests and for gradients.

Distances are written from their geometry and rotations as matrices, not from the kernels.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rotation(quaternion: Tensor) -> Tensor:
    """Rotation matrix [3, 3] of a quaternion w, x, y, z of any length; zero turns nothing."""
    if not bool(quaternion.norm() > 0):
        return torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)
    w, x, y, z = (quaternion / quaternion.norm()).tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return quaternion.new_tensor(rows)


def _unit(v: Tensor, fallback: tuple[float, float, float]) -> Tensor:
    length = v.norm(dim=-1, keepdim=True)
    return torch.where(length > 0, v / length.clamp_min(1e-300), v.new_tensor(fallback))


def _corner(h: Tensor, up: Tensor, q: Tensor, out: Tensor) -> tuple[Tensor, Tensor]:
    """Two half spaces that meet at right angles: both distances <= 0 is inside."""
    a, b = h.clamp_min(0)[..., None] * up, q.clamp_min(0)[..., None] * out
    far = (h > 0) & (q > 0)
    nearest = torch.where((h >= q)[..., None], up, out)
    distance = torch.where(far, (a + b).norm(dim=-1), torch.maximum(h, q))
    return distance, torch.where(far[..., None], _unit(a + b, (0.0, 0.0, 1.0)), nearest)


def _box(p: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    q = p.abs() - half
    sign = torch.where(p < 0, -1.0, 1.0)
    out = sign * q.clamp_min(0)
    axis = torch.nn.functional.one_hot(q.argmax(dim=-1), 3).to(p.dtype)
    outside = (q > 0).any(dim=-1)
    normal = torch.where(outside[..., None], _unit(out, (0.0, 0.0, 1.0)), sign * axis)
    return torch.where(outside, out.norm(dim=-1), q.amax(dim=-1)), normal


def _grid(row: Tensor, sdf: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    size = [int(v) for v in row[26:29]]
    start = 64 * int(row[29])
    values = sdf[start : start + size[0] * size[1] * size[2]].to(p.dtype).view(size)
    last = p.new_tensor(size) - 1
    u = (p - row[6:9]) / row[9]
    inside = torch.minimum(u.clamp_min(0), last)
    base = torch.minimum(inside.floor(), last - 1).long()
    f = inside - base
    total, slope = torch.zeros_like(p[..., 0]), torch.zeros_like(p)
    for corner in torch.cartesian_prod(*[torch.arange(2, device=p.device)] * 3):
        w = torch.where(corner.bool(), f, 1 - f)
        value = values[(base + corner).unbind(-1)]
        total = total + w.prod(dim=-1) * value
        rest = torch.stack([w[..., 1] * w[..., 2], w[..., 0] * w[..., 2], w[..., 0] * w[..., 1]])
        slope = slope + (2 * corner - 1) * rest.movedim(0, -1) * value[..., None]
    beyond = (u - inside) * row[9]
    gap = beyond.norm(dim=-1)
    outer = gap > 0
    normal = torch.where(outer[..., None], beyond, slope)
    distance = torch.where(outer, torch.maximum(gap, total - gap), total)
    return distance, _unit(normal, (0.0, 0.0, 1.0))


def signed_distance(row: Tensor, sdf: Tensor | None, x: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance [m] of points x [..., 3] from one collider row [32], and its unit normal."""
    kind, radius, half = int(row[0]), row[9], row[28]
    turn = rotation(row[16:20])
    p = (x - row[3:6]) @ turn
    up, flat = p.new_tensor([0.0, 0.0, 1.0]), p * p.new_tensor([1.0, 1.0, 0.0])
    if kind == -1:
        return torch.full_like(p[..., 0], torch.inf), up.expand_as(p)
    if kind == 0:
        n = row[6:9] / row[6:9].norm()
        h = p @ n
        side = p - h[..., None] * n
        if radius == 0:
            d, normal = h, n.expand_as(p)
        else:
            axis = n.expand_as(p)
            out = torch.where(side.norm(dim=-1, keepdim=True) > 0, _unit(side, (0, 0, 1)), axis)
            d, normal = _corner(h, axis, side.norm(dim=-1) - radius, out)
    elif kind == 1:
        d, normal = p.norm(dim=-1) - radius, _unit(p, (0.0, 0.0, 1.0))
    elif kind == 2:
        d, normal = _box(p, row[26:29])
    elif kind == 3:
        away = p - p[..., 2:].clamp(-half, half) * up
        d, normal = away.norm(dim=-1) - radius, _unit(away, (1.0, 0.0, 0.0))
    elif kind == 4:
        top = torch.where(p[..., 2:] < 0, -up, up)
        side = flat.norm(dim=-1) - radius
        d, normal = _corner(p[..., 2].abs() - half, top, side, _unit(flat, (1.0, 0.0, 0.0)))
    elif kind == 6:
        over = (p[..., :2].abs() <= row[26:28]).all(dim=-1) & (p[..., 2] >= -half)
        d, normal = torch.where(over, p[..., 2], torch.inf), up.expand_as(p)
    else:
        assert sdf is not None
        d, normal = _grid(row, sdf, p)
    return d, normal @ turn.T


def give(row: Tensor, contact_mass: Tensor) -> Tensor:
    """Share of the velocity change that nodes get from a collider with mass."""
    mass, kind, mode, mu = row[14], int(row[0]), int(row[1]), row[2]
    if not bool(mass > 0):
        return torch.ones_like(mass)
    e, r = row[26:29], row[9]
    bounds = {
        1: r,
        2: e.norm(),
        6: e.norm(),
        3: r + e[2],
        4: torch.hypot(r, e[2]),
        5: torch.maximum(-row[6:9], row[6:9] + (e - 1) * r).norm(),
    }
    moments = row[23:26][row[23:26] > 0]
    turning = mass * bounds[kind] ** 2 / moments.min() if len(moments) else 0 * mass
    if kind == 1:
        turning = turning * (mode == 0) + turning * (mode == 2) * mu**2 / (1 + mu**2)
    return 1 / (1 + contact_mass / mass * (1 + turning))


def acting_mass(row: Tensor, mass: Tensor, cut: Tensor | None) -> Tensor:
    """Masses [K, ...] of the fields that a collider acts on; 0 for the others."""
    if row[30] == 0:
        return mass
    sides = torch.zeros(mass.shape[0], dtype=torch.int32) if cut is None else cut
    acts = (sides.to(mass.device) >> (int(row[30]) - 1)) & 1
    return torch.where(acts.view(-1, *(1,) * (mass.ndim - 1)) != 0, mass, 0.0)


def first_touch(
    row: Tensor, sdf: Tensor | None, x: Tensor, path: Tensor, dx: float
) -> tuple[Tensor, Tensor]:
    """Part of the relative ``path`` after the first touch (0: no touch) and the normal there.

    By looking at 400 places and bisection between two of them; differentiable with respect to the
    path to first order.
    """
    still = path.detach()

    def near(s: Tensor) -> Tensor:
        return signed_distance(row, sdf, x + s[..., None] * still)[0] <= 1e-3 * dx

    d, normal = signed_distance(row, sdf, x)
    inside = d <= 1e-4 * dx
    high = torch.full_like(d, 2.0)
    for i in range(1, 401):
        s = torch.full_like(d, i / 400)
        high = torch.where(near(s) & (high > 1), s, high)
    low = high - 1 / 400
    for _ in range(40):
        middle = 0.5 * (low + high)
        hit = near(middle)
        high, low = torch.where(hit, middle, high), torch.where(hit, low, middle)
    at = x + high[..., None] * still
    _, there = signed_distance(row, sdf, at)
    closing = (still * there).sum(-1)
    touches = (high <= 1) & (closing < 0) & ~inside
    moved = high * ((path - still) * there).sum(-1) / torch.where(touches, closing, 1.0)
    share = torch.where(touches, 1 - (high - moved), inside.to(x.dtype))
    return share, torch.where(inside[..., None], normal, there)


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
        share, n = first_touch(row, sdf, x.expand_as(velocity), dt * relative, dx)
    else:
        d, n = signed_distance(row, sdf, x)
        share = (d <= 1e-4 * dx).to(x.dtype)
    share = share[..., None]
    vn = (relative * n).sum(-1, keepdim=True)
    slip = relative - vn * n
    if mode == 0:
        after = own.expand_as(velocity)
    elif mode == 1:
        after = own + slip
    else:
        speed = slip.norm(dim=-1, keepdim=True)
        drag = -friction * (1 + restitution) * vn
        sticks = (drag >= speed) & (drag > 0)
        kept = torch.where(sticks, 0.0, 1.0 - drag / torch.where((speed > 0) & ~sticks, speed, 1.0))
        bounced = own + kept * slip - restitution * vn * n
        after = torch.where(vn < 0, bounced, velocity)
    heavy = mass > 1e-30
    touching = torch.where(heavy & (share[..., 0] > 0), mass, 0.0).sum()
    changed = velocity + share * give(row, touching) * (after - velocity)
    return torch.where(heavy[..., None] & (share > 0), changed, velocity)
