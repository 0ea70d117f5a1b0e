"""Transfers of the textbook solver: stencils, sums in a chosen order, walls. Plain PyTorch.

Written from equations.md section 8 (quadratic and linear B-splines, APIC, PIC, FLIP; MLS force or
exact gradient). The grid is dense over the box around the points.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

DENSE_NODES, DENSE_SHARE = 2**16, 8
"""Nodes, and nodes per node of a point, beyond which the box around the points is compacted to the
nodes that are used: points that fly apart make a box of air."""
_BITS = 40
"""Of the largest summand in the fixed-point sums."""


class Stencil(NamedTuple):
    """Nodes of every point."""

    node: Tensor  # index of each node of a point, int64 [N, S]
    weight: Tensor  # its weight, [N, S]
    slope: Tensor  # gradient of the weight with respect to the point [1/m], [N, S, 3]
    place: Tensor  # of the point from its first node [dx], [N, 3]
    corner: Tensor  # of each node from the first [dx], [S, 3]
    size: int  # nodes in all
    lattice: Tensor  # integer coordinates of every node, int64 [size, 3]


def stencil(cell: Tensor, offset: Tensor, dx: float, kernel: str) -> Stencil:
    """Nodes, weights and slopes of points at ``cell + offset`` [dx].

    Args:
        cell: int64 [N, 3].
        offset: [N, 3], any size.
        dx: Node spacing [m].
        kernel: ``quadratic`` (27 nodes) or ``linear`` (8 nodes).

    Raises:
        FloatingPointError: A point is nowhere or farther than 2^40 cells away, or the box around
            the points is longer than 2^20 cells.
    """
    shift = 0.5 if kernel == "quadratic" else 0.0
    first = torch.floor(offset - shift)
    f = offset - first
    if kernel == "quadratic":
        w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2], 2)
        s = torch.stack([f - 1.5, -2.0 * (f - 1.0), f - 0.5], 2) / dx
    else:
        w = torch.stack([1.0 - f, f], 2)
        s = torch.stack([torch.full_like(f, -1.0), torch.ones_like(f)], 2) / dx
    if not bool(torch.isfinite(first).all() & (first.abs() < 2.0**40).all()):
        raise FloatingPointError("a point is not finite or has left every grid")
    base = cell + first.long()
    width = w.shape[2]
    axis = torch.arange(width, device=base.device)
    corner = torch.cartesian_prod(axis, axis, axis)
    low = base.amin(0)
    extent = [int(n) for n in (base.amax(0) - low + width).tolist()]
    if max(extent) > 2**20:  # indices of 60 bits
        raise FloatingPointError(f"points fly apart: the box around them is {max(extent)} cells")
    stride = torch.tensor([extent[1] * extent[2], extent[2], 1], device=base.device)
    node = ((base - low) * stride).sum(1)[:, None] + (corner * stride).sum(1)
    size = extent[0] * extent[1] * extent[2]
    if size > max(DENSE_NODES, DENSE_SHARE * node.numel()):
        used, node = torch.unique(node, return_inverse=True)
        size = used.shape[0]
    else:
        used = torch.arange(size, device=base.device)
    lattice = torch.stack(
        [used // stride[0], used // stride[1] % extent[1], used % extent[2]], dim=1
    )
    i, j, k = corner.unbind(1)
    wx, wy, wz = w[:, 0, i], w[:, 1, j], w[:, 2, k]
    slope = torch.stack([s[:, 0, i] * wy * wz, wx * s[:, 1, j] * wz, wx * wy * s[:, 2, k]], dim=2)
    return Stencil(node, wx * wy * wz, slope, f, corner.to(f.dtype), size, lattice + low)


def node_positions(s: Stencil, dx: float) -> Tensor:
    """Positions of all nodes [m], float64 [size, 3]."""
    return s.lattice.double() * dx


@contextlib.contextmanager
def deterministic(wanted: bool) -> Iterator[None]:
    """Have scattered sums on a GPU made in the order of their summands, inside the block."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(wanted or before)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


def scatter(node: Tensor, values: Tensor, size: int, sums: str, order: Tensor | None) -> Tensor:
    """Sum values at nodes.

    Args:
        node: int64 [N, S].
        values: [N, S, C].
        size: Nodes in all.
        sums: ``plain`` in the precision of ``values``, ``float64``, or ``fixed``: 64-bit integers
            (2^-40 of the largest summand), which no order changes.
        order: Points in the order in which they are added, int64 [N]; None as they are.

    Returns:
        [size, C].
    """
    if order is not None:
        node, values = node[order], values[order]
    channels = values.shape[2]
    where, given = node.reshape(-1), values.reshape(-1, channels)
    if sums == "plain":
        return given.new_zeros(size, channels).index_add_(0, where, given)
    wide = given.double()
    if sums == "float64":
        return wide.new_zeros(size, channels).index_add_(0, where, wide).to(values.dtype)
    largest = wide.abs().amax(0).clamp(min=1e-300)
    scale = torch.exp2(_BITS - torch.ceil(torch.log2(largest)))
    whole = (wide * scale).round().long()
    total = torch.zeros(size, channels, dtype=torch.int64, device=node.device)
    return (total.index_add_(0, where, whole).double() / scale).to(values.dtype)


def collide(velocity: Tensor, x: Tensor, planes: Sequence[Mapping[str, Any]], dx: float) -> Tensor:
    """Velocities of nodes after planes (a node at or behind one is in it): equations.md 8."""
    for plane in planes:
        n = torch.tensor([float(c) for c in plane["normal"]], dtype=x.dtype, device=x.device)
        n = n / n.norm()
        point = torch.tensor([float(c) for c in plane["point"]], dtype=x.dtype, device=x.device)
        inside = ((x - point) @ n <= 1e-4 * dx)[:, None]
        n = n.to(velocity.dtype)
        normal = velocity @ n
        slip = velocity - normal[:, None] * n
        if plane["kind"] == "sticky":
            after = torch.zeros_like(velocity)
        elif plane["kind"] == "slip":
            after = slip
        else:
            size = slip.norm(dim=1)
            drag = float(plane.get("friction", 0.0)) * normal.abs()
            left = (size - drag).clamp(min=0.0) / torch.where(size > 0, size, 1.0)
            after = torch.where((normal < 0)[:, None], left[:, None] * slip, velocity)
        velocity = torch.where(inside, after, velocity)
    return velocity


def contact(
    velocity: Tensor, mass: Tensor, outward: Tensor, centre: Tensor, dx: float, friction: float
) -> Tensor:
    """Velocities of nodes that two bodies share, after an inelastic impulse: equations.md 11.3.

    Args:
        velocity: Of every field [m/s], [K, G, 3].
        mass: [kg], [K, G].
        outward: Sum of mass times gradient of the weights, which points out of a body, [K, G, 3].
        centre: Mass centroids of the points that reach a node [m], [K, G, 3].
        dx: Node spacing [m]; bodies touch where their centroids are nearer along the normal.
        friction: Coulomb coefficient.
    """
    velocity = velocity.clone()
    for a in range(velocity.shape[0]):
        for b in range(a + 1, velocity.shape[0]):
            both = (mass[a] > 0) & (mass[b] > 0)
            rows = both.nonzero()[:, 0]
            if rows.shape[0] == 0:
                continue
            ma, mb = mass[a, rows], mass[b, rows]
            normal = _unit(_unit(outward[a, rows]) - _unit(outward[b, rows]))
            relative = velocity[a, rows] - velocity[b, rows]
            closing = (relative * normal).sum(1)
            gap = ((centre[b, rows] - centre[a, rows]) * normal).sum(1)
            touch = (closing > 0) & (gap <= dx)
            reduced = ma * mb / (ma + mb)
            push = torch.where(touch, reduced * closing, 0.0)
            slip = relative - closing[:, None] * normal
            speed = slip.norm(dim=1)
            drag = torch.minimum(friction * push, reduced * speed)
            impulse = push[:, None] * normal + drag[:, None] * _unit(slip)
            velocity[a, rows] -= impulse / ma[:, None]
            velocity[b, rows] += impulse / mb[:, None]
    return velocity


def _unit(v: Tensor) -> Tensor:
    size = v.norm(dim=1, keepdim=True)
    return v / torch.where(size > 0, size, 1.0)
