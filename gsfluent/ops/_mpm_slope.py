"""Derivatives of particle-grid transfers with respect to the particle positions.

``transfer_slope`` is the derivative of ``sum_i w_i g_i . (c + S (x_i - x_p))``: with g the gradient
of the grid it is what p2g needs, with g the grid velocity what g2p needs. Its CPU kernel is
``csrc/cpu/mpm/transfer.cpp``; here is its definition, which also serves CUDA. ``moments_backward``
is the gradient of the contact moments of p2g.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from gsfluent.ops.blocks import Blocks

CHUNK = 1 << 15  # particles whose 27 nodes are laid out at once


def _gathered(
    grid: Tensor, position: Tensor, body: Tensor | None, blocks: Blocks, dx: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Covered particles, chunk by chunk: their indices, positions and values at 27 nodes."""
    from gsfluent.ops.reference import mpm as reference

    channels = grid.shape[-1]
    per_field = blocks.coords.shape[0] * 64
    covered = reference.covered(position, dx, blocks, body, grid.shape[0]).nonzero().squeeze(1)
    for rows in covered.split(CHUNK):
        x = position[rows]
        node, _, _ = reference.stencil(x, dx)
        flat = reference.node_index(node, blocks)
        if body is not None:
            flat = flat + body[rows].long()[:, None] * per_field
        yield rows, x, grid.reshape(-1, channels)[flat]


def _offsets(x: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """Weights [N, 27] and x_i - x_p [N, 27, 3], differentiable in x."""
    from gsfluent.ops.reference import mpm as reference

    node, weight, _ = reference.stencil(x, dx)
    return weight, node.to(x.dtype) * dx - x[:, None]


def transfer_slope(
    grid: Tensor,
    constant: Tensor,
    linear: Tensor,
    position: Tensor,
    body: Tensor | None,
    *where: Any,
) -> Tensor:
    """Derivative of ``sum_i w_i g_i . (c + S (x_i - x_p))`` with respect to ``x_p``.

    Args:
        grid: Node values g, [K, B, 64, 4].
        constant: c, [N, 4].
        linear: S of the first three channels, [N, 3, 3].
        position: Particle positions [m], [N, 3].
        body: Field of each particle, int32 [N] or None.
        where: :meth:`gsfluent.ops.Blocks.parts`.

    Returns:
        [N, 3]; zero for particles the blocks do not cover.
    """
    blocks, dx = Blocks.of(*where[:-1]), where[-1]
    slope = torch.zeros_like(position)
    for rows, x, g in _gathered(grid, position, body, blocks, dx):
        c, s = constant[rows], linear[rows]

        def total(x: Tensor, g: Tensor = g, c: Tensor = c, s: Tensor = s) -> Tensor:
            weight, d = _offsets(x, dx)
            pushed = torch.einsum("nia,nab,nib->ni", g[..., :3], s, d)
            return (weight * ((g * c[:, None]).sum(-1) + pushed)).sum()

        slope[rows] = torch.func.grad(total)(x)
    return slope


torch.library.register_kernel("gsfluent::transfer_slope", "cuda")(transfer_slope)


@torch.library.custom_op(
    "gsfluent::moments_backward",
    mutates_args=(),
    schema="(Tensor g_moments, Tensor position, Tensor mass, Tensor? body, Tensor table, "
    "Tensor coords, Tensor order, Tensor start, int[] origin, int margin, float dx) "
    "-> (Tensor, Tensor)",
)
def _moments_backward(
    g_moments: Tensor, position: Tensor, mass: Tensor, body: Tensor | None, *where: Any
) -> tuple[Tensor, Tensor]:
    """Gradients of position and mass through the contact moments of p2g."""
    blocks, dx = Blocks.of(*where[:-1]), where[-1]
    g_position, g_mass = torch.zeros_like(position), torch.zeros_like(mass)
    for rows, x, h in _gathered(g_moments, position, body, blocks, dx):

        def total(x: Tensor, m: Tensor, h: Tensor = h) -> Tensor:
            weight, d = _offsets(x, dx)
            return -(m * (weight * (h * d).sum(-1)).sum(1)).sum() / dx

        slope: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
        slope = torch.func.grad(total, argnums=(0, 1))
        g_position[rows], g_mass[rows] = slope(x, mass[rows])
    return g_position, g_mass


_moments_backward.register_fake(
    lambda h, position, mass, *rest: (torch.empty_like(position), torch.empty_like(mass))
)
