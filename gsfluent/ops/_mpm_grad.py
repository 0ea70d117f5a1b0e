"""Gradients of the MPM operators (:mod:`gsfluent.ops.mpm`).

p2g and g2p are adjoint: the gradient of the scatter is a gather, the gradient of the gather is a
scatter, so both backward passes are calls of the same kernels. The derivative with respect to the
positions, through the weights, is one more gather: :mod:`gsfluent.ops._mpm_slope`. Contact and
colliders are piecewise smooth; their gradient is that of the reference
(:mod:`gsfluent.ops.reference.mpm`), in float64, on the piece the forward pass was on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent.ops import _mpm_slope  # noqa: F401  (registers slopes)
from gsfluent.ops._register import fakes
from gsfluent.ops.blocks import Blocks

MASS_FLOOR = 1e-30  # core/mpm/contact.h mass_floor


def _full(stress: Tensor) -> Tensor:
    """xx, yy, zz, xy, xz, yz -> symmetric matrix."""
    return stress[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)


def _four(vector: Tensor, last: Tensor | None = None) -> Tensor:
    """[..., 3] and [...] (default 0) -> [..., 4]."""
    if last is None:
        last = vector.new_zeros(vector.shape[:-1])
    return torch.cat([vector, last[..., None]], dim=-1)


def _p2g_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:11])
    ctx.origin, ctx.margin, ctx.dx, ctx.dt = inputs[11:15]


def _p2g_backward(
    ctx: Any, g_grid: Tensor | None, g_moments: Tensor | None, _: Tensor | None
) -> tuple[Tensor | None, ...]:
    position, velocity, affine, mass, stress, volume, body, *index = ctx.saved_tensors
    where = (*index, ctx.origin, ctx.margin, ctx.dx)
    g_position = g_velocity = g_affine = g_mass = g_stress = g_volume = None
    if g_grid is not None:
        value, first = torch.ops.gsfluent.p2g_adjoint(g_grid, position, body, *where)
        g_velocity = mass[:, None] * value[:, :3]
        g_affine = mass[:, None, None] * first
        g_mass = (velocity * value[:, :3]).sum(1) + (affine * first).sum((1, 2)) + value[:, 3]
        slope = mass[:, None, None] * affine
        if stress is not None:
            scale = -ctx.dt * 4.0 / ctx.dx**2
            push = _full(stress)
            slope = slope + scale * volume[:, None, None] * push
            i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
            pull = first[:, i, j] + first[:, j, i]  # a symmetric pair of entries is one component
            g_stress = scale * volume[:, None] * torch.cat([0.5 * pull[:, :3], pull[:, 3:]], dim=1)
            g_volume = scale * (push * first).sum((1, 2))
        if ctx.needs_input_grad[0]:
            constant = _four(mass[:, None] * velocity, mass)
            g_position = torch.ops.gsfluent.transfer_slope(
                g_grid, constant, slope, position, body, *where
            )
    if g_moments is not None and g_moments.numel():
        moved, weighed = torch.ops.gsfluent.moments_backward(
            g_moments, position, mass, body, *where
        )
        g_position = moved if g_position is None else g_position + moved
        g_mass = weighed if g_mass is None else g_mass + weighed
    return g_position, g_velocity, g_affine, g_mass, g_stress, g_volume, *((None,) * 11)


def _g2p_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    velocity_grid, position, _, deformation, body = inputs[:5]
    ctx.set_materialize_grads(False)
    grid = velocity_grid if ctx.needs_input_grad[1] else None
    ctx.save_for_backward(position, deformation, body, output[2], grid, *inputs[5:9])
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
    position, deformation, body, affine, velocity_grid, *index = ctx.saved_tensors
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
    matrix = (4.0 / ctx.dx**2) * matrix
    g_grid = g_x = g_kept = None
    where = (*index, ctx.origin, ctx.margin, ctx.dx)
    if ctx.needs_input_grad[0]:
        points = (position, vector, matrix, position.new_ones(n), None, None, body)
        scattered, _, _ = torch.ops.gsfluent.p2g(*points, *where, 0.0, ctx.fields, False)
        g_grid = scattered[..., :3].contiguous()
    if ctx.needs_input_grad[1]:
        g_x = torch.ops.gsfluent.transfer_slope(
            _four(velocity_grid), _four(vector), matrix, position, body, *where
        )
        if g_position is not None:
            g_x = g_x + g_position
    if ctx.needs_input_grad[2]:
        # Weights sum to one at covered particles and to nothing at skipped ones.
        ones = position.new_ones((ctx.fields, index[1].shape[0], 64, 4))
        covered, _ = torch.ops.gsfluent.p2g_adjoint(ones, position, body, *where)
        g_kept = torch.where(covered[:, 3:] > 0.5, torch.zeros_like(vector), vector)
    return g_grid, g_x, g_kept, g_f, *((None,) * 9)


def _grid_update_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    if inputs[2] is not None and ctx.needs_input_grad[2]:
        raise NotImplementedError(
            "grid_update: no gradient with respect to colliders; detach the rows"
        )
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:8])
    ctx.options = inputs[8:]


def _grid_update_backward(
    ctx: Any, g_velocity: Tensor | None, g_impulse: Tensor | None, *_: Tensor | None
) -> tuple[Tensor | None, ...]:
    saved = ctx.saved_tensors  # a checkpoint hands them out once
    grid, moments, colliders, _, merged, *_ = saved
    rest: tuple[None, ...] = (None,) * 15
    if g_velocity is None and g_impulse is None:
        return None, None, *rest
    free = moments is None and merged is None
    if free and (colliders is None or colliders.shape[0] == 0):
        return None if g_velocity is None else _divided(g_velocity, grid), None, *rest
    g_grid, g_moments = torch.ops.gsfluent.grid_update_backward(
        g_velocity, g_impulse, *saved, *ctx.options
    )
    return g_grid, g_moments if moments is not None else None, *rest


def _divided(g_velocity: Tensor, grid: Tensor) -> Tensor:
    """Gradient of the grid through ``momentum / mass``."""
    mass = grid[..., 3:]
    heavy = mass > MASS_FLOOR
    inverse = torch.where(heavy, 1.0 / torch.where(heavy, mass, torch.ones_like(mass)), 0.0)
    g_momentum = g_velocity * inverse
    g_mass = -(g_momentum * grid[..., :3]).sum(-1, keepdim=True) * inverse
    return torch.cat([g_momentum, g_mass], dim=-1)


def _touched(rows: Tensor, sdf: Tensor | None, blocks: Blocks, dx: float) -> Tensor | None:
    """Blocks with nodes in a collider, bool [B]; None where one acts beyond what lies in it."""
    from gsfluent.ops.collider import pad_colliders
    from gsfluent.ops.reference.collider import signed_distance

    x = blocks.node_positions(dx)
    found = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    for row in pad_colliders(rows.double()):
        if bool(row[15] != 0):  # swept: acts on what would pass through
            return None
        found |= (signed_distance(row, sdf, x)[0] <= 1e-3 * dx).any(dim=1)
    return found


@torch.library.custom_op(
    "gsfluent::grid_update_backward",
    mutates_args=(),
    schema="(Tensor? g_velocity, Tensor? g_impulse, Tensor grid, Tensor? moments, "
    "Tensor? colliders, Tensor? sdf, Tensor? merged, Tensor? cut, Tensor table, Tensor coords, "
    "int[] origin, float dx, float dt, float gravity_x, float gravity_y, float gravity_z, "
    "float friction, float restitution, float contact_gap) -> (Tensor, Tensor)",
)
def _grid_update_by_reference(
    g_velocity: Tensor | None,
    g_impulse: Tensor | None,
    grid: Tensor,
    moments: Tensor | None,
    colliders: Tensor | None,
    sdf: Tensor | None,
    merged: Tensor | None,
    cut: Tensor | None,
    table: Tensor,
    coords: Tensor,
    origin: Sequence[int],
    dx: float,
    dt: float,
    *numbers: float,
) -> tuple[Tensor, Tensor]:
    from gsfluent.ops.reference import mpm as reference
    from gsfluent.ops.reference.contact import pairs

    none = coords.new_empty(0)
    blocks = Blocks.of(table, coords, none, none, origin, 1)
    friction, restitution, contact_gap = numbers[3:]
    options: dict[str, Any] = {
        "dx": dx, "dt": dt, "gravity": numbers[:3], "sdf": sdf, "cut": cut,
        "colliders": None if colliders is None else colliders.double(),
        "merged": None if merged is None else pairs(merged),
        "friction": friction, "restitution": restitution, "contact_gap": contact_gap,
    }  # fmt: skip

    def forward(grid: Tensor, moments: Tensor | None) -> tuple[Tensor, Tensor]:
        velocity, impulse, torque, _ = reference.grid_update(
            grid, blocks=blocks, moments=moments, **options
        )
        return velocity, torch.cat([impulse, torque], dim=1)

    # torch.func works inside a custom op, where ordinary autograd is switched off.
    count = 0 if colliders is None else colliders.shape[0]
    g_v = grid.new_zeros((*grid.shape[:3], 3)) if g_velocity is None else g_velocity
    g_i = grid.new_zeros(count, 6) if g_impulse is None else g_impulse
    if moments is None:
        near = None
        if merged is None and colliders is not None:
            near = _touched(colliders, sdf, blocks, dx)
        if near is None:
            near = torch.ones(coords.shape[0], dtype=torch.bool, device=coords.device)
        g_grid = _divided(g_v, grid)
        if not bool(near.any()):
            return g_grid, grid.new_empty(0)
        blocks = blocks._replace(coords=coords[near])
        _, pull_back, *_ = torch.func.vjp(lambda g: forward(g, None), grid[:, near].double())
        (part,) = pull_back((g_v[:, near].double(), g_i.double()))
        g_grid[:, near] = part.to(grid.dtype)
        return g_grid, grid.new_empty(0)
    _, pull_back, *_ = torch.func.vjp(forward, grid.double(), moments.double())
    g_grid, g_moments = pull_back((g_v.double(), g_i.double()))
    return g_grid.to(grid.dtype), g_moments.to(grid.dtype)


def _p2g_shapes(position: Tensor, *rest: Any) -> tuple[Tensor, Tensor, Tensor]:
    coords, (fields, contact) = rest[7], rest[-2:]
    grid = position.new_empty((fields, len(coords), 64, 4))
    moments = position.new_empty((fields if contact else 0, len(coords), 64, 3))
    return grid, moments, position.new_empty((), dtype=torch.int64)


def _g2p_shapes(
    grid: Tensor, position: Tensor, velocity: Tensor | None, deformation: Tensor | None, *rest: Any
) -> tuple[Tensor, ...]:
    n = len(position)
    shapes = ((n, 3), (n, 3), (n, 3, 3), (0 if deformation is None else n, 3, 3))
    return *map(position.new_empty, shapes), position.new_empty((), dtype=torch.int64)


def _grid_update_shapes(
    grid: Tensor, moments: Tensor | None, colliders: Tensor | None, *rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rows, wide = 0 if colliders is None else len(colliders), torch.float64
    impulse, mass = (grid.new_empty(shape, dtype=wide) for shape in ((rows, 6), (rows,)))
    velocity = grid.new_empty((*grid.shape[:2], 64, 3))
    return velocity, impulse, mass, grid.new_empty((), dtype=torch.int64)


fakes(
    p2g=_p2g_shapes,
    g2p=_g2p_shapes,
    grid_update=_grid_update_shapes,
    p2g_adjoint=lambda grid, x, *rest: (x.new_empty((len(x), 4)), x.new_empty((len(x), 3, 3))),
    transfer_slope=lambda grid, constant, linear, x, *rest: x.new_empty((len(x), 3)),
)
_grid_update_by_reference.register_fake(
    lambda gv, gi, grid, moments, *rest: (
        torch.empty_like(grid),
        grid.new_empty(0) if moments is None else torch.empty_like(moments),
    )
)
torch.library.register_autograd("gsfluent::p2g", _p2g_backward, setup_context=_p2g_setup)
torch.library.register_autograd("gsfluent::g2p", _g2p_backward, setup_context=_g2p_setup)
torch.library.register_autograd(
    "gsfluent::grid_update", _grid_update_backward, setup_context=_grid_update_setup
)
