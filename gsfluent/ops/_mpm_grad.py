"""Shape functions and gradients of the MPM operators (:mod:`gsfluent.ops.mpm`).

p2g and g2p are adjoint: the gradient of the scatter is a gather, the gradient of the gather is a
scatter, so both backward passes are calls of the same kernels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

MASS_FLOOR = 1e-30  # core/contact.h mass_floor


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
    moments = position.new_empty((fields if contact else 0, count, 64, 6))
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


def _full(stress: Tensor) -> Tensor:
    """xx, yy, zz, xy, xz, yz -> symmetric matrix."""
    return stress[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)


def _p2g_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    position, velocity, affine, mass, stress, volume, body = inputs[:7]
    if ctx.needs_input_grad[0]:
        raise NotImplementedError(
            "p2g: no gradient with respect to position; detach it or differentiate the velocity"
        )
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(position, velocity, affine, mass, stress, volume, body, *inputs[7:11])
    ctx.origin, ctx.margin, ctx.dx, ctx.dt = inputs[11:15]


def _p2g_backward(
    ctx: Any, g_grid: Tensor | None, g_moments: Tensor | None, _: Tensor | None
) -> tuple[Tensor | None, ...]:
    if g_moments is not None and g_moments.numel():
        raise NotImplementedError("p2g: no gradient through moments (contact)")
    none: tuple[None, ...] = (None,)
    if g_grid is None:
        return none * 17
    position, velocity, affine, mass, stress, volume, body, *index = ctx.saved_tensors
    value, first = torch.ops.gsfluent.p2g_adjoint(
        g_grid, position, body, *index, ctx.origin, ctx.margin, ctx.dx
    )
    g_velocity = mass[:, None] * value[:, :3]
    g_affine = mass[:, None, None] * first
    g_mass = (velocity * value[:, :3]).sum(1) + (affine * first).sum((1, 2)) + value[:, 3]
    g_stress = g_volume = None
    if stress is not None:
        scale = -ctx.dt * 4.0 / ctx.dx**2
        pull = torch.stack(
            [
                first[:, 0, 0],
                first[:, 1, 1],
                first[:, 2, 2],
                first[:, 0, 1] + first[:, 1, 0],
                first[:, 0, 2] + first[:, 2, 0],
                first[:, 1, 2] + first[:, 2, 1],
            ],
            dim=1,
        )
        g_stress = scale * volume[:, None] * pull
        g_volume = scale * (_full(stress) * first).sum((1, 2))
    return None, g_velocity, g_affine, g_mass, g_stress, g_volume, *(none * 11)


def _g2p_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    velocity_grid, position, _, deformation, body = inputs[:5]
    if ctx.needs_input_grad[1]:
        raise NotImplementedError(
            "g2p: no gradient with respect to position; detach it or differentiate velocity_grid"
        )
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(position, deformation, body, output[2], *inputs[5:9])
    ctx.fields = velocity_grid.shape[0]
    ctx.origin, ctx.margin, ctx.dx, ctx.dt = inputs[9:13]


def _g2p_backward(
    ctx: Any,
    g_position: Tensor | None,
    g_velocity: Tensor | None,
    g_affine: Tensor | None,
    g_deformation: Tensor | None,
    _: Tensor | None,
) -> tuple[Tensor | None, ...]:
    position, deformation, body, affine, *index = ctx.saved_tensors
    n = position.shape[0]
    vector = position.new_zeros(n, 3)
    if g_velocity is not None:
        vector = vector + g_velocity
    if g_position is not None:
        vector = vector + ctx.dt * g_position
    matrix = position.new_zeros(n, 3, 3)
    if g_affine is not None:
        matrix = matrix + g_affine
    g_f = None
    if g_deformation is not None and deformation is not None:
        matrix = matrix + ctx.dt * g_deformation @ deformation.mT
        g_f = g_deformation + ctx.dt * affine.mT @ g_deformation
    g_grid = g_kept = None
    where = (*index, ctx.origin, ctx.margin, ctx.dx)
    if ctx.needs_input_grad[0]:
        scattered, _, _ = torch.ops.gsfluent.p2g(
            position,
            vector,
            (4.0 / ctx.dx**2) * matrix,
            position.new_ones(n),
            None,
            None,
            body,
            *where,
            0.0,
            ctx.fields,
            False,
        )
        g_grid = scattered[..., :3].contiguous()
    if ctx.needs_input_grad[2]:
        # Weights sum to one at covered particles and to nothing at skipped ones.
        ones = position.new_ones((ctx.fields, index[1].shape[0], 64, 4))
        covered, _ = torch.ops.gsfluent.p2g_adjoint(ones, position, body, *where)
        g_kept = torch.where(covered[:, 3:] > 0.5, torch.zeros_like(vector), vector)
    return g_grid, None, g_kept, g_f, *((None,) * 9)


def _grid_update_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    grid, moments, colliders = inputs[:3]
    if moments is not None or (colliders is not None and colliders.shape[0]):
        raise NotImplementedError(
            "grid_update: no gradient through contact or colliders; pass moments=None and "
            "colliders=None, or call it under torch.no_grad()"
        )
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(grid)


def _grid_update_backward(
    ctx: Any, g_velocity: Tensor | None, *_: Tensor | None
) -> tuple[Tensor | None, ...]:
    none: tuple[None, ...] = (None,)
    if g_velocity is None:
        return none * 13
    (grid,) = ctx.saved_tensors
    mass = grid[..., 3:]
    heavy = mass > MASS_FLOOR
    inverse = torch.where(heavy, 1.0 / torch.where(heavy, mass, torch.ones_like(mass)), 0.0)
    g_momentum = g_velocity * inverse
    g_mass = -(g_momentum * grid[..., :3]).sum(-1, keepdim=True) * inverse
    return torch.cat([g_momentum, g_mass], dim=-1), *(none * 12)


torch.library.register_autograd("gsfluent::p2g", _p2g_backward, setup_context=_p2g_setup)
torch.library.register_autograd("gsfluent::g2p", _g2p_backward, setup_context=_g2p_setup)
torch.library.register_autograd(
    "gsfluent::grid_update", _grid_update_backward, setup_context=_grid_update_setup
)
