"""The MPM operators in plain PyTorch, dense over (particle, 27 nodes): the definition, for tests.

Written from docs/theory/mpm.md, not from the kernels; run it in float64.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent.ops.blocks import Blocks
from gsfluent.ops.collider import pad_colliders
from gsfluent.ops.reference.collider import acting_mass, collide
from gsfluent.ops.reference.contact import STEPS, contact, groups, merge


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
    node, w, _ = stencil(x, dx)
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
        first = -d / dx * (m[:, None] * w)[..., None]
        moments = position.new_zeros(fields * total, 3).index_add(0, where, first.reshape(-1, 3))
        moments = moments.view(fields, -1, 64, 3)
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


def neighbours(channels: Tensor, blocks: Blocks) -> Tensor:
    """Values of every node and its neighbours, 0 without one: [K, B, 64, C] -> [..., 27, C]."""
    fields, _, _, width = channels.shape
    axis = torch.arange(4, device=channels.device)
    local = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(64, 1, 3)
    step = torch.tensor(STEPS, device=channels.device)
    flat = node_index(blocks.coords[:, None, None].long() * 4 + local + step, blocks)
    padded = torch.cat(
        [channels.reshape(fields, -1, width), channels.new_zeros(fields, 1, width)], 1
    )
    return padded[:, flat]  # -1 is the zero at the end


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
    merged: Tensor | None = None,
    cut: Tensor | None = None,
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
    group = None if merged is None else groups(merged, heavy[..., 0])
    if moments is not None:
        law = (friction, restitution, contact_gap)
        near = neighbours(torch.cat([torch.where(heavy, mass, 0.0), moments], -1), blocks)
        for a in range(grid.shape[0]):
            for b in range(a + 1, grid.shape[0]):
                va, vb, touch = contact(
                    (velocity[a], velocity[b]),
                    (near[a, ..., 0], near[b, ..., 0]),
                    (near[a, ..., 1:], near[b, ..., 1:]),
                    law,
                )
                if group is not None:
                    touch = touch & ~group[..., a, b]
                velocity = velocity.clone()
                velocity[a] = torch.where(touch[..., None], va, velocity[a])
                velocity[b] = torch.where(touch[..., None], vb, velocity[b])
                touched |= touch
    if group is not None:
        velocity = merge(velocity, mass, group)
    impulses, torques = [], []
    x = blocks.node_positions(dx, grid.dtype)
    for row in [] if colliders is None else pad_colliders(colliders):
        after = collide(row, sdf, x, velocity, acting_mass(row, mass[..., 0], cut), dx, dt)
        given = (mass * (after - velocity)).double()
        impulses.append(given.sum(dim=(0, 1, 2)))
        arm = (x - row[3:6]).double().expand_as(given)
        torques.append(torch.linalg.cross(arm, given).sum(dim=(0, 1, 2)))
        velocity = after
    none = grid.new_zeros(0, 3, dtype=torch.float64)
    impulse = torch.stack(impulses) if impulses else none
    torque = torch.stack(torques) if torques else none
    return velocity, impulse, torque, touched.sum()
