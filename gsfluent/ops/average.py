"""Averages of what points carry over their neighbourhood, on a grid: pressure without point noise.

A composition of :func:`gsfluent.ops.p2g` and :func:`gsfluent.ops.g2p`, so that it runs and has
gradients where they do. Equations: docs/theory/liquids.md.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops.blocks import build_blocks
from gsfluent.ops.mpm import g2p, p2g

SLOPES = 2
"""Times that the slope of the average is found anew; each brings it nearer at a free surface."""


def kernel_average(values: Tensor, *, position: Tensor, mass: Tensor, length: float) -> Tensor:
    """Average of values over the quadratic B-splines of a grid, by mass, with its slope.

    ``u_i = sum w m (u_p + g_p d) / sum w m`` and ``u_p' = sum w u_i`` with ``d = x_i - x_p``. The
    slope ``g_p = (4 / length^2) sum w u_i d`` is that of the average before, so that a field that
    is linear in space is kept inside of matter and nearly so at its surface. What changes from
    point to point goes: quadrature of the material point method leaves the pressure of a liquid
    at rest a noise of its own size in the lowest cells.

    Args:
        values: What is averaged, one to three values a point, [N] or [N, K].
        position: Positions [m], [N, 3].
        mass: Masses [kg], [N].
        length: Edge of a cell of the averaging grid [m]; an average reaches 1.5 of it. Two cells
            of the grid of the simulation are a good choice.

    Returns:
        The averages, of the shape of ``values``.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or ``length`` is wrong, or a position is not finite.

    Gradient: ``values``, ``position`` and ``mass``. Source: Jiang et al. 2015 (APIC) for the
    transfer with slopes.
    """
    op = "kernel_average"
    check_tensor(op, "position", position, shape=("N", 3))
    count = position.shape[0]
    check_tensor(op, "mass", mass, shape=(count,), like=position)
    columns = values.reshape(count, -1) if count else values.reshape(0, max(values.dim(), 1))
    if values.dim() not in (1, 2) or values.shape[0] != count or not 1 <= columns.shape[1] <= 3:
        raise ValueError(f"{op}: values must be [{count}] or [{count}, 1 to 3], got "
                         f"{list(values.shape)}")  # fmt: skip
    if not (math.isfinite(length) and length > 0.0):
        raise ValueError(f"{op}: length must be positive, got {length}")
    if count == 0:
        return values.clone()
    given = torch.nn.functional.pad(columns, (0, 3 - columns.shape[1])).to(position)
    blocks = build_blocks(position, dx=length)
    slope = torch.zeros(count, 3, 3, dtype=position.dtype, device=position.device)
    found = given
    for _ in range(SLOPES + 1):
        grid, _ = p2g(position, given, slope, mass, dx=length, blocks=blocks)
        sums, weight = grid[..., :3], grid[..., 3:]
        nodes = torch.where(weight > 0.0, sums / torch.where(weight > 0.0, weight, 1.0), 0.0)
        _, found, slope, _ = g2p(nodes.contiguous(), position, dx=length, dt=0.0, blocks=blocks)
    return found[:, : columns.shape[1]].reshape(values.shape).to(values)
