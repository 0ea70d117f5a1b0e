"""Shape functions of the MPM operators (:mod:`gsfluent.ops.mpm`), for torch.compile and opcheck."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


@torch.library.register_fake("gsfluent::p2g")
def _p2g_fake(
    position: Tensor,
    velocity: Tensor,
    affine: Tensor,
    mass: Tensor,
    stress: Tensor | None,
    volume: Tensor | None,
    body: Tensor | None,
    table: Tensor,
    coords: Tensor,
    order: Tensor,
    start: Tensor,
    origin: Sequence[int],
    margin: int,
    dx: float,
    dt: float,
    fields: int,
    contact: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    count = coords.shape[0]
    grid = position.new_empty((fields, count, 64, 4))
    moments = position.new_empty((fields if contact else 0, count, 64, 3))
    return grid, moments, position.new_empty((), dtype=torch.int64)


@torch.library.register_fake("gsfluent::p2g_adjoint")
def _p2g_adjoint_fake(
    grid: Tensor, position: Tensor, body: Tensor | None, *blocks_and_dx: Any
) -> tuple[Tensor, Tensor]:
    n = position.shape[0]
    return position.new_empty((n, 4)), position.new_empty((n, 3, 3))


@torch.library.register_fake("gsfluent::grid_update")
def _grid_update_fake(
    grid: Tensor, moments: Tensor | None, colliders: Tensor | None, *rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rows = 0 if colliders is None else colliders.shape[0]
    velocity = grid.new_empty((grid.shape[0], grid.shape[1], 64, 3))
    impulse = grid.new_empty((rows, 6), dtype=torch.float64)
    mass = grid.new_empty((rows,), dtype=torch.float64)
    return velocity, impulse, mass, grid.new_empty((), dtype=torch.int64)


@torch.library.register_fake("gsfluent::g2p")
def _g2p_fake(
    velocity_grid: Tensor,
    position: Tensor,
    velocity: Tensor | None,
    deformation: Tensor | None,
    *rest: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    n = position.shape[0]
    return (
        position.new_empty((n, 3)),
        position.new_empty((n, 3)),
        position.new_empty((n, 3, 3)),
        position.new_empty((0 if deformation is None else n, 3, 3)),
        position.new_empty((), dtype=torch.int64),
    )


@torch.library.register_fake("gsfluent::transfer_slope")
def _transfer_slope_fake(
    grid: Tensor, constant: Tensor, linear: Tensor, position: Tensor, *rest: Any
) -> Tensor:
    return position.new_empty((position.shape[0], 3))
