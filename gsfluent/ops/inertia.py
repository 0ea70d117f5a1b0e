"""Masses of points by which a thin body turns as fast on a grid as it should.

A composition of :func:`gsfluent.ops.p2g` and :func:`gsfluent.ops.g2p`, once before a run.
Equations: docs/theory/mpm.md.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops.blocks import build_blocks
from gsfluent.ops.mpm import g2p, p2g

LEAST = 0.4
"""Smallest share: lighter points could need shorter steps."""
PARTS = 64
"""Shares are whole multiples of about one over this: a solver keeps few different points."""


def inertial_shares(position: Tensor, *, volume: Tensor, dx: float) -> Tensor:
    """Mass of each point over density times volume, for the body's own moment of inertia.

    A grid spreads every mass by ``dx^2 / 4`` along each axis, so a body turns as if it were
    larger. Here points near its surface give mass to those below, by ``lambda (f - S f)`` of their
    own: ``f`` is how full of matter the surroundings are, ``S`` the transfer to nodes and back,
    which keeps the sum. ``lambda`` makes the body's moment of inertia on the grid what it is in
    space, as far as no share falls below :data:`LEAST`: that is reached with bodies of three
    cells and less.

    Args:
        position: Positions of one body at rest [m], [N, 3].
        volume: Volumes of the points [m^3], [N], which fill the body evenly.
        dx: Node spacing [m].

    Returns:
        Shares, [N]; their mean by volume is 1.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or ``dx`` is wrong, a position is not finite, a volume not positive.

    Gradient: none.
    """
    op = "inertial_shares"
    check_tensor(op, "position", position, shape=("N", 3))
    count = position.shape[0]
    check_tensor(op, "volume", volume, shape=(count,), like=position)
    if not (math.isfinite(dx) and dx > 0.0):
        raise ValueError(f"{op}: dx must be positive, got {dx}")
    if count == 0:
        return torch.ones_like(volume)
    if not bool((volume > 0.0).all()):
        raise ValueError(f"{op}: volume must be positive, got {float(volume.min())}")
    x, v = position.detach().double() / dx, volume.detach().double() / dx**3
    blocks = build_blocks(x, dx=1.0)
    still = torch.zeros(count, 3, 3, dtype=x.dtype, device=x.device)

    def there_and_back(values: Tensor, divide: bool) -> Tensor:
        given = torch.nn.functional.pad(values[:, None], (0, 2))
        grid, _ = p2g(x, given, still, v, dx=1.0, blocks=blocks)
        nodes, weight = grid[..., :3], grid[..., 3:]
        if divide:
            nodes = torch.where(weight > 0.0, nodes / torch.where(weight > 0.0, weight, 1.0), 0.0)
        return g2p(nodes.contiguous(), x, dx=1.0, dt=0.0, blocks=blocks)[1][:, 0]

    full = there_and_back(torch.ones_like(v), divide=False)
    lack = full - there_and_back(full, divide=True)
    arm = x - (v[:, None] * x).sum(0) / v.sum()
    moved = float((v * lack * (arm * arm).sum(1)).sum())  # negative: inwards
    # what the grid adds, less what points have less than the boxes that they stand for
    wanted = -float((v * (0.75 - 0.25 * v ** (2.0 / 3.0))).sum())
    deepest = float(lack.min())
    if not (moved < 0.0 and deepest < 0.0):  # a single point
        return torch.ones_like(volume)
    scale = min(max(wanted / moved, 0.0), (1.0 - LEAST) / -deepest)
    shares = 1.0 + (PARTS * scale * lack).round() / PARTS
    return (shares * (v.sum() / (v * shares).sum())).to(volume)
