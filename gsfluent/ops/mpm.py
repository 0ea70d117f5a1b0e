"""Material point method on a sparse grid: build_blocks, p2g, grid_update, g2p.

MLS-MPM with quadratic B-splines and APIC transfer (Jiang et al. 2015; Hu et al. 2018). The formulas
with their sources are in ``docs/theory/mpm.md``. Sparse grid: :mod:`gsfluent.ops.blocks`; shape
functions and gradients: :mod:`gsfluent.ops._mpm_grad`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, overload

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops import _mpm_grad  # noqa: F401  (registers shape functions and gradients)
from gsfluent.ops.blocks import Blocks, build_blocks, check_blocks, check_dx, check_order
from gsfluent.ops.collider import check_rows

__all__ = ["Blocks", "build_blocks", "g2p", "grid_update", "p2g"]

MAX_FIELDS = 64


def _check_dt(op: str, dt: float) -> float:
    if not abs(float(dt)) < float("inf"):
        raise ValueError(f"{op}: dt must be a finite number, got {dt}")
    return float(dt)


def _check_body(op: str, body: Tensor | None, count: int, like: Tensor) -> None:
    if body is not None:
        check_tensor(op, "body", body, shape=(count,), dtype=torch.int32, like=like)


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
    """Scatter particle mass and momentum (with the stress impulse) to the grid.

    ``m_i = sum w m_p`` and ``(m v)_i = sum w [m_p (v_p + C_p d) - dt V_p (4 / dx^2) tau_p d]`` with
    ``d = x_i - x_p``: fused MLS-MPM, the weight applied once.

    Args:
        position: Positions [m], shape [N, 3].
        velocity: Velocities [m/s], shape [N, 3].
        affine: APIC matrices C [1/s], shape [N, 3, 3].
        mass: Masses [kg], shape [N].
        dx: Node spacing [m].
        blocks: From :func:`build_blocks` for these particles.
        dt: Time step of the stress impulse [s].
        stress: Kirchhoff stress tau [Pa] as xx, yy, zz, xy, xz, yz, shape [N, 6].
        volume: Initial volumes [m^3], shape [N]; required with ``stress``.
        body: Field of each particle in [0, fields), int32 [N]; None puts all into field 0.
        fields: Number of separate velocity fields K, 1 to 64.
        contact: Also accumulate what :func:`grid_update` needs for contact between fields.

    Returns:
        ``grid`` [K, B, 64, 4]: momentum [kg m/s] and mass [kg] per node; ``moments``
        [K, B, 64, 3] or None: first moment of the mass about the node in cells,
        ``sum w m (x_p - x_i) / dx`` [kg].

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape, device or range; blocks built for another particle count.

    A particle that is not finite, not covered by ``blocks`` or not in a field gives nothing;
    :func:`g2p` counts the same particles. Gradient: every floating tensor, ``position`` included,
    through ``grid`` and ``moments`` (docs/theory/gradients.md). Determinism: on the CPU the result
    does not depend on the number of threads; on CUDA sums are reordered by atomics.
    Source: Jiang et al. 2015; Hu et al. 2018; docs/theory/mpm.md.
    """
    op = "p2g"
    check_tensor(op, "position", position, shape=(None, 3))
    n = position.shape[0]
    check_tensor(op, "velocity", velocity, shape=(n, 3), like=position)
    check_tensor(op, "affine", affine, shape=(n, 3, 3), like=position)
    check_tensor(op, "mass", mass, shape=(n,), like=position)
    if (stress is None) != (volume is None):
        raise ValueError(f"{op}: stress and volume must be given together")
    if stress is not None:
        check_tensor(op, "stress", stress, shape=(n, 6), like=position)
        check_tensor(op, "volume", volume, shape=(n,), like=position)
    _check_body(op, body, n, position)
    if not 1 <= fields <= MAX_FIELDS:
        raise ValueError(f"{op}: fields must be 1 to {MAX_FIELDS}, got {fields}")
    check_blocks(op, blocks, position)
    check_order(op, blocks, n)
    points = (position, velocity, affine, mass, stress, volume, body)
    where = blocks.parts(check_dx(op, dx))
    grid, moments, _ = torch.ops.gsfluent.p2g(*points, *where, _check_dt(op, dt), fields, contact)
    return grid, moments if contact else None


def _pair_bits(merged: Tensor) -> Tensor:
    """Bit g of word f says that f and g, or g and f, are a pair: bool [K, K] -> int64 [K]."""
    bit = torch.ones(len(merged), dtype=torch.int64, device=merged.device)
    bit = bit << torch.arange(len(merged), device=merged.device)
    return torch.where(merged | merged.mT, bit, 0).sum(1)


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
    return_torque: bool = False,
) -> tuple[Tensor, ...]:
    """Turn nodal momentum into velocity: gravity, contact between fields, rigid colliders.

    Contact between every pair of fields that meet at a node uses the corrected Collision-MPM
    impulse: normal from the moments of the node and its neighbours (docs/theory/contact.md),
    active only while the centroids of the two masses overlap within ``contact_gap * dx`` and the
    bodies approach, Coulomb friction. Momentum is exchanged exactly. Colliders act afterwards, in
    row order. A collider with mass changes velocities as a plastic impact of its mass with that of
    the nodes it touches would.

    Args:
        grid: Momentum and mass from :func:`p2g`, shape [K, B, 64, 4].
        dx: Node spacing [m].
        dt: Time step [s].
        blocks: The blocks of ``grid``.
        gravity: Acceleration [m/s^2], three numbers.
        colliders: Rows from :func:`gsfluent.ops.collider_row`, shape [M, 32]; also accepted are
            [M, 16]: ``[type, mode, friction, px, py, pz, nx, ny, nz, radius, vx, vy, vz,
            restitution, 0, 0]`` with type 0 plane, 1 sphere.
        sdf: Values of the distance grids of mesh colliders [m], float32 [S].
        moments: From :func:`p2g` with ``contact=True``; None switches contact off.
        merged: Pairs of fields that are parts of one body and move as one (at shared nodes: one
            velocity, no contact), bool [K, K], taken as symmetric and transitive.
        cut: Sides of blades that each field lies on (:func:`gsfluent.ops.blade_sides`), int32
            [K]; colliders with ``only_cut`` act on those fields only.
        friction: Coulomb coefficient between fields, >= 0.
        restitution: Of contact between fields, in [0, 1]. Exact in this step; over the steps of a
            lasting contact it makes energy, which is why :class:`Solver` has none
            (docs/theory/contact.md).
        contact_gap: Centroid separation [dx] below which fields touch; 1.0 to 1.1 is right for
            8 particles per cell.
        return_torque: Also return the torque of the colliders.

    Returns:
        ``velocity`` [K, B, 64, 3] in m/s, zero at nodes without mass; ``impulse`` float64 [M, 3]
        given to the bodies by each collider [N s]; with ``return_torque`` its ``torque`` about the
        collider's point float64 [M, 3] [N m s]; ``contact_nodes`` int64 [], nodes where fields
        touched.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape, device or range; on the CPU also a row that is no collider (on
            CUDA such a row does nothing and its impulse is NaN).
        NotImplementedError: A gradient with respect to ``colliders``.

    Gradient: ``grid`` and ``moments``, through velocity and impulse; on the piece (touching or not,
    sticking or sliding) the forward pass was on. Determinism: independent of thread count on the
    CPU and of scheduling on CUDA.
    Source: Bardenhagen et al. 2001; the corrected force of docs/theory/mpm.md.
    """
    op = "grid_update"
    check_tensor(op, "grid", grid, shape=(None, None, 64, 4))
    check_blocks(op, blocks, grid)
    fields, count = grid.shape[:2]
    if not 1 <= fields <= MAX_FIELDS:
        raise ValueError(f"{op}: grid must have 1 to {MAX_FIELDS} fields, got {fields}")
    check_tensor(op, "grid", grid, shape=(fields, blocks.block_count, 64, 4))
    if moments is not None:
        check_tensor(op, "moments", moments, shape=(fields, count, 64, 3), like=grid)
    if merged is not None:
        check_tensor(op, "merged", merged, shape=(fields, fields), dtype=torch.bool, like=grid)
        merged = _pair_bits(merged)
    if cut is not None:
        check_tensor(op, "cut", cut, shape=(fields,), dtype=torch.int32, like=grid)
    rows = None if colliders is None else check_rows(op, colliders, sdf, grid)
    if len(gravity) != 3:
        raise ValueError(f"{op}: gravity must have three numbers, got {len(gravity)}")
    if not friction >= 0.0:
        raise ValueError(f"{op}: friction must be >= 0, got {friction}")
    if not 0.0 <= restitution <= 1.0:
        raise ValueError(
            f"{op}: restitution must be in [0, 1] (more creates energy), got {restitution}"
        )
    things = (grid, moments, rows, sdf, merged, cut)
    where = (blocks.table, blocks.coords, blocks.origin, check_dx(op, dx), _check_dt(op, dt))
    numbers = (*gravity, friction, restitution, contact_gap)
    velocity, impulse, _, contact_nodes = torch.ops.gsfluent.grid_update(
        *things, *where, *(float(v) for v in numbers)
    )
    push, torque = impulse[:, :3].contiguous(), impulse[:, 3:].contiguous()
    if return_torque:
        return velocity, push, torque, contact_nodes
    return velocity, push, contact_nodes


@overload
def g2p(
    velocity_grid: Tensor,
    position: Tensor,
    *,
    dx: float,
    dt: float,
    blocks: Blocks,
    body: Tensor | None = ...,
    deformation: Tensor | None = ...,
    velocity: Tensor | None = ...,
    return_skipped: Literal[False] = ...,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]: ...


@overload
def g2p(
    velocity_grid: Tensor,
    position: Tensor,
    *,
    dx: float,
    dt: float,
    blocks: Blocks,
    body: Tensor | None = ...,
    deformation: Tensor | None = ...,
    velocity: Tensor | None = ...,
    return_skipped: Literal[True],
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor]: ...


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
    return_skipped: bool = False,
) -> tuple[Tensor | None, ...]:
    """Gather grid velocity to the particles and move them.

    ``v' = sum w v_i``, ``C' = (4 / dx^2) sum w v_i (x_i - x_p)^T``, ``x' = x + dt v'``,
    ``F' = (I + dt C') F``.

    Args:
        velocity_grid: Node velocities from :func:`grid_update` [m/s], shape [K, B, 64, 3].
        position: Positions at the time of :func:`p2g` [m], shape [N, 3].
        dx: Node spacing [m].
        dt: Time step [s].
        blocks: The blocks used in :func:`p2g`.
        body: Field of each particle, int32 [N]; None reads field 0.
        deformation: Deformation gradients F, shape [N, 3, 3].
        velocity: Velocities before the step [m/s], shape [N, 3]. Particles the blocks do not cover
            fly on with it; without it they stop.
        return_skipped: Also return how many particles were skipped.

    Returns:
        ``position'`` [N, 3], ``velocity'`` [N, 3], ``affine'`` [N, 3, 3], ``deformation'``
        [N, 3, 3] or None; with ``return_skipped`` also an int64 [] tensor: particles that are not
        finite, not covered by ``blocks`` or not in a field. Those keep F and lose C. When it is not
        zero, call :func:`build_blocks` again (it names particles that are not finite).

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape, device or range; blocks built for another particle count.

    Gradient: ``velocity_grid``, ``position``, ``deformation``, ``velocity``. Deterministic on
    CPU and CUDA.
    Source: Jiang et al. 2015; Hu et al. 2018; docs/theory/mpm.md.
    """
    op = "g2p"
    check_tensor(op, "position", position, shape=(None, 3))
    n = position.shape[0]
    check_blocks(op, blocks, position)
    check_order(op, blocks, n)
    shape = (None, blocks.block_count, 64, 3)
    check_tensor(op, "velocity_grid", velocity_grid, shape=shape, like=position)
    if not 1 <= velocity_grid.shape[0] <= MAX_FIELDS:
        raise ValueError(
            f"{op}: velocity_grid must have 1 to {MAX_FIELDS} fields, got {velocity_grid.shape[0]}"
        )
    _check_body(op, body, n, position)
    if deformation is not None:
        check_tensor(op, "deformation", deformation, shape=(n, 3, 3), like=position)
    if velocity is not None:
        check_tensor(op, "velocity", velocity, shape=(n, 3), like=position)
    points, where = (position, velocity, deformation, body), blocks.parts(check_dx(op, dx))
    x, v, c, f, skipped = torch.ops.gsfluent.g2p(velocity_grid, *points, *where, _check_dt(op, dt))
    moved = (x, v, c, f if deformation is not None else None)
    return (*moved, skipped) if return_skipped else moved
