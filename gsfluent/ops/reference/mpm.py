"""The MPM operators in plain PyTorch, dense over (particle, 27 nodes): the definition, for tests.

Written from docs/mpm.md, not from the kernels; run it in float64.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent.ops.collider import pad_colliders
from gsfluent.ops.mpm import Blocks
from gsfluent.ops.reference.collider import collide


def stencil(position: Tensor, dx: float) -> tuple[Tensor, Tensor, Tensor]:
    """27 nodes of every particle.

    Returns:
        Node coordinates int64 [N, 27, 3], weights [N, 27], weight gradients with respect to the
        particle position [1/m], [N, 27, 3].
    """
    scaled = position / dx
    base = torch.floor(scaled - 0.5)
    f = scaled - base  # in [0.5, 1.5)
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], dim=2)
    slope = torch.stack([f - 1.5, -2 * (f - 1), f - 0.5], dim=2) / dx
    axis = torch.arange(3, device=position.device)
    local = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(27, 3)
    i, j, k = local.unbind(1)
    wx, wy, wz = w[:, 0, i], w[:, 1, j], w[:, 2, k]
    gradient = torch.stack(
        [slope[:, 0, i] * wy * wz, wx * slope[:, 1, j] * wz, wx * wy * slope[:, 2, k]], dim=2
    )
    return base.long()[:, None] + local, wx * wy * wz, gradient


def node_index(node: Tensor, blocks: Blocks) -> Tensor:
    """Flat index ``block * 64 + local`` of node coordinates, -1 where no block is active."""
    origin = torch.tensor(blocks.origin, device=node.device)
    cell = torch.div(node, 4, rounding_mode="floor")
    at = cell - origin
    size = torch.tensor(blocks.table.shape, device=node.device)
    inside = ((at >= 0) & (at < size)).all(dim=-1)
    at = torch.where(inside[..., None], at, torch.zeros_like(at))
    block = blocks.table[at[..., 0], at[..., 1], at[..., 2]].long()
    block = torch.where(inside, block, torch.full_like(block, -1))
    local = node - 4 * cell
    flat = block * 64 + (local[..., 0] * 4 + local[..., 1]) * 4 + local[..., 2]
    return torch.where(block >= 0, flat, torch.full_like(flat, -1))


def covered(
    position: Tensor, dx: float, blocks: Blocks, body: Tensor | None, fields: int
) -> Tensor:
    """Particles that are finite, in a field, and whose 27 nodes are all active; bool [N]."""
    finite = torch.isfinite(position).all(dim=1) & (position.abs() < 1e8 * dx).all(dim=1)
    safe = torch.where(finite[:, None], position, torch.zeros_like(position))
    node, _, _ = stencil(safe, dx)
    good = finite & (node_index(node, blocks) >= 0).all(dim=1)
    return good if body is None else good & (body >= 0) & (body < fields)


def p2g(
    position: Tensor,
    velocity: Tensor,
    affine: Tensor,
    mass: Tensor,
    *,
    dx: float,
    blocks: Blocks,
    dt: float = 0.0,
    stress: Tensor | None = None,
    volume: Tensor | None = None,
    body: Tensor | None = None,
    fields: int = 1,
    contact: bool = False,
) -> tuple[Tensor, Tensor | None]:
    """Reference of :func:`gsfluent.ops.p2g`."""
    good = covered(position, dx, blocks, body, fields)
    x, v, c, m = position[good], velocity[good], affine[good], mass[good]
    field = torch.zeros_like(m, dtype=torch.long) if body is None else body[good].long()
    node, w, gradient = stencil(x, dx)
    d = node.to(x.dtype) * dx - x[:, None]
    momentum = m[:, None, None] * (v[:, None] + torch.einsum("nab,nib->nia", c, d))
    if stress is not None and volume is not None:
        tau = stress[good][:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)
        scale = -dt * volume[good] * 4.0 / dx**2
        momentum = momentum + scale[:, None, None] * torch.einsum("nab,nib->nia", tau, d)
    total = blocks.coords.shape[0] * 64
    where = (field[:, None] * total + node_index(node, blocks)).reshape(-1)
    given = torch.cat([momentum, m[:, None, None].expand(-1, 27, 1)], dim=2) * w[..., None]
    grid = position.new_zeros(fields * total, 4).index_add(0, where, given.reshape(-1, 4))
    moments = None
    if contact:
        both = torch.cat([gradient, -d * w[..., None]], dim=2) * m[:, None, None]
        moments = position.new_zeros(fields * total, 6).index_add(0, where, both.reshape(-1, 6))
        moments = moments.view(fields, -1, 64, 6)
    return grid.view(fields, -1, 64, 4), moments


def g2p(
    velocity_grid: Tensor,
    position: Tensor,
    *,
    dx: float,
    dt: float,
    blocks: Blocks,
    body: Tensor | None = None,
    deformation: Tensor | None = None,
    velocity: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor]:
    """Reference of :func:`gsfluent.ops.g2p` with ``return_skipped=True``."""
    fields = velocity_grid.shape[0]
    good = covered(position, dx, blocks, body, fields)
    x = position[good]
    field = torch.zeros_like(x[:, 0], dtype=torch.long) if body is None else body[good].long()
    node, w, _ = stencil(x, dx)
    where = field[:, None] * blocks.coords.shape[0] * 64 + node_index(node, blocks)
    taken = velocity_grid.reshape(-1, 3)[where] * w[..., None]
    d = node.to(x.dtype) * dx - x[:, None]
    v_new = torch.zeros_like(position) if velocity is None else velocity.clone()
    v_new[good] = taken.sum(dim=1)
    c_new = position.new_zeros(position.shape[0], 3, 3)
    c_new[good] = 4.0 / dx**2 * torch.einsum("nia,nib->nab", taken, d)
    f_new = None if deformation is None else deformation + dt * c_new @ deformation
    return position + dt * v_new, v_new, c_new, f_new, (~good).sum()


def _contact(
    grid: Tensor,
    velocity: Tensor,
    moments: Tensor,
    a: int,
    b: int,
    law: tuple[float, float, float],
    dx: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """One pair of fields at every node: new velocities of both and where they touched."""
    friction, restitution, gap = law
    ma, mb = grid[a, ..., 3:], grid[b, ..., 3:]
    shared = (ma > 0) & (mb > 0)
    ma, mb = torch.where(shared, ma, 1.0), torch.where(shared, mb, 1.0)
    ga, gb = moments[a, ..., :3], moments[b, ..., :3]
    la, lb = ga.norm(dim=-1, keepdim=True), gb.norm(dim=-1, keepdim=True)
    sharp_a, sharp_b = la * dx / ma, lb * dx / mb
    ua = torch.where(sharp_a >= 1e-6, ga / la.clamp_min(1e-300), 0.0)
    ub = torch.where(sharp_b >= 1e-6, gb / lb.clamp_min(1e-300), 0.0)
    n = ua - ub
    length = n.norm(dim=-1, keepdim=True)
    n = torch.where(
        length >= 0.1, n / length.clamp_min(1e-300), torch.where(sharp_a >= sharp_b, ua, -ub)
    )
    apart = ((moments[b, ..., 3:] / mb - moments[a, ..., 3:] / ma) * n).sum(-1, keepdim=True)
    relative = velocity[a] - velocity[b]
    approach = (relative * n).sum(-1, keepdim=True)
    touch = shared & (torch.maximum(sharp_a, sharp_b) >= 1e-6)
    touch &= (apart <= gap * dx) & (approach > 0)
    reduced = ma * mb / (ma + mb)
    jn = (1 + restitution) * reduced * approach
    slip = relative - approach * n
    speed = slip.norm(dim=-1, keepdim=True)
    # min(friction j_n, m_r |slip|) slip / |slip|, without the 0 / 0 of a node that does not slide.
    slides = (friction * jn < reduced * speed) & (speed > 0)
    drag = torch.where(slides, friction * jn / torch.where(slides, speed, 1.0), reduced)
    impulse = torch.where(touch, jn * n + drag * slip, 0.0)
    return velocity[a] - impulse / ma, velocity[b] + impulse / mb, touch.squeeze(-1)


def grid_update(
    grid: Tensor,
    *,
    dx: float,
    dt: float,
    blocks: Blocks,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    colliders: Tensor | None = None,
    sdf: Tensor | None = None,
    moments: Tensor | None = None,
    friction: float = 0.3,
    restitution: float = 0.0,
    contact_gap: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Reference of :func:`gsfluent.ops.grid_update` with ``return_torque=True``."""
    mass = grid[..., 3:]
    heavy = mass > 1e-30
    velocity = grid[..., :3] / torch.where(heavy, mass, 1.0) + dt * grid.new_tensor(gravity)
    velocity = torch.where(heavy, velocity, 0.0)
    touched = torch.zeros(grid.shape[1:3], dtype=torch.bool, device=grid.device)
    if moments is not None:
        law = (friction, restitution, contact_gap)
        for a in range(grid.shape[0]):
            for b in range(a + 1, grid.shape[0]):
                va, vb, touch = _contact(grid, velocity, moments, a, b, law, dx)
                velocity = velocity.clone()
                velocity[a], velocity[b] = va, vb
                touched |= touch
    impulses, torques = [], []
    x = blocks.node_positions(dx, grid.dtype)
    for row in [] if colliders is None else pad_colliders(colliders):
        after = collide(row, sdf, x, velocity, mass[..., 0], dx, dt)
        given = (mass * (after - velocity)).double()
        impulses.append(given.sum(dim=(0, 1, 2)))
        arm = (x - row[3:6]).double().expand_as(given)
        torques.append(torch.linalg.cross(arm, given).sum(dim=(0, 1, 2)))
        velocity = after
    none = grid.new_zeros(0, 3, dtype=torch.float64)
    impulse = torch.stack(impulses) if impulses else none
    torque = torch.stack(torques) if torques else none
    return velocity, impulse, torque, touched.sum()
