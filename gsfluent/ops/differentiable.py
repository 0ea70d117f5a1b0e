"""Differentiable time steps: one explicit MPM step of the operators, and many with checkpointing.

For fitting parameters to what was seen: a loss on final positions or velocities is differentiated
with respect to the initial state and the material (:func:`material_params`). The resident solver is
the fast way forward; this is the same step in composable operators.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsfluent._check import check_tensor
from gsfluent.ops.mpm import build_blocks, g2p, grid_update, p2g
from gsfluent.ops.plasticity import LAWS, return_mapping


class MpmState(NamedTuple):
    """What a step changes, from :func:`mpm_state`.

    Attributes:
        position: Positions [m], [N, 3].
        velocity: Velocities [m/s], [N, 3].
        affine: APIC matrices C [1/s], [N, 3, 3].
        strain: Elastic strain b - I as xx, yy, zz, xy, xz, yz, [N, 6].
        alpha: Log plastic volume ratio, [N].
        stress: Kirchhoff stress of ``strain`` [Pa], [N, 6].
    """

    position: Tensor
    velocity: Tensor
    affine: Tensor
    strain: Tensor
    alpha: Tensor
    stress: Tensor


def material_params(
    young_modulus: Tensor | float,
    poisson_ratio: Tensor | float,
    *,
    friction: Tensor | float = 0.0,
    cohesion: Tensor | float = 0.0,
    hardening: Tensor | float = 0.0,
    shear_damage: Tensor | float = 0.0,
    density: Tensor | float = 0.0,
) -> Tensor:
    """Rows of ``params`` for elastic and NACC material, differentiable in every argument.

    Args:
        young_modulus: E [Pa], a number or [M].
        poisson_ratio: nu, in (-1, 0.5).
        friction: Slope M of the critical state line.
        cohesion: beta, tensile over compressive strength.
        hardening: xi.
        shear_damage: eta.
        density: [kg/m^3]; column 6, which the return mapping does not read.

    Returns:
        [M, 8] for :func:`gsfluent.ops.return_mapping`: mu, kappa, M, beta, xi, eta, density, 0.
        float64 unless the tensors say otherwise; M = 1 when every argument is a number.

    Raises:
        ValueError: The arguments do not have one common length.

    Gradient: every argument, ``mu = E / (2 (1 + nu))``, ``kappa = E / (3 (1 - 2 nu))``.
    """
    given = (young_modulus, poisson_ratio, friction, cohesion, hardening, shear_damage, density)
    tensors = [t for t in given if isinstance(t, Tensor)]
    like = tensors[0] if tensors else torch.zeros((), dtype=torch.float64)
    columns = [torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in given]
    try:
        columns = list(torch.broadcast_tensors(*(c.reshape(-1) for c in columns)))
    except RuntimeError:
        shapes = ", ".join(str(list(c.shape)) for c in columns)
        raise ValueError(
            f"material_params: arguments must be numbers or have one length, got {shapes}"
        ) from None
    e, nu, *rest = columns
    mu, kappa = e / (2.0 * (1.0 + nu)), e / (3.0 * (1.0 - 2.0 * nu))
    return torch.stack([mu, kappa, *rest, torch.zeros_like(mu)], dim=1)


def mpm_state(
    position: Tensor,
    velocity: Tensor,
    *,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    affine: Tensor | None = None,
    strain: Tensor | None = None,
    alpha: Tensor | None = None,
) -> MpmState:
    """The state :func:`mpm_step` starts from.

    Args:
        position: Positions [m], [N, 3].
        velocity: Velocities [m/s], [N, 3].
        law: int32 [M], see :func:`gsfluent.ops.return_mapping`.
        params: [M, 8], for example from :func:`material_params`.
        material: Row of each particle, int32 [N], or None.
        affine: APIC matrices [1/s], [N, 3, 3]; None is no spin and no strain rate.
        strain: Elastic strain, [N, 6]; None is rest. What lies outside the yield surface is
            returned to it.
        alpha: Log plastic volume ratio, [N]; None is 0. Material of another law than elastic needs
            it: NACC at 0 is broken.

    Returns:
        The state, with the stress of ``strain``.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device, law, parameter or row is wrong, or alpha is missing.

    Gradient: every floating tensor, ``params`` through the stress.
    """
    op = "mpm_state"
    check_tensor(op, "position", position, shape=(None, 3))
    n = position.shape[0]
    check_tensor(op, "velocity", velocity, shape=(n, 3), like=position)
    if alpha is None:
        kept = [LAWS[name] for name in ("elastic", "corotated", "yeoh", "ogden")]
        stateless = torch.isin(law, torch.tensor(kept, device=law.device, dtype=law.dtype))
        if not bool(stateless.all()):
            raise ValueError(f"{op}: alpha must be given for material that is not elastic")
        alpha = position.new_zeros(n)
    if affine is None:
        affine = position.new_zeros(n, 3, 3)
    check_tensor(op, "affine", affine, shape=(n, 3, 3), like=position)
    check_tensor(op, "alpha", alpha, shape=(n,), like=position)
    if strain is None:
        zero = position.new_zeros(n, 6)
        return MpmState(position, velocity, affine, zero, alpha, zero)
    check_tensor(op, "strain", strain, shape=(n, 6), like=position)
    strain, alpha, stress, _ = return_mapping(
        strain, alpha, position.new_zeros(n, 3, 3), law=law, params=params, material=material
    )
    return MpmState(position, velocity, affine, strain, alpha, stress)


def mpm_step(
    state: MpmState,
    *,
    mass: Tensor,
    volume: Tensor,
    dx: float,
    dt: float,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    body: Tensor | None = None,
    fields: int = 1,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    colliders: Tensor | None = None,
    friction: float = 0.3,
    restitution: float = 0.0,
    contact_gap: float = 1.0,
    **return_map: Any,
) -> MpmState:
    """One explicit time step: p2g, grid_update, g2p, return_mapping.

    Args:
        state: From :func:`mpm_state` or the last step.
        mass: Masses [kg], [N].
        volume: Initial volumes [m^3], [N].
        dx: Node spacing [m].
        dt: Time step [s]; stable below about ``0.5 dx / (wave speed + |v|)``.
        law: int32 [M], see :func:`gsfluent.ops.return_mapping`.
        params: [M, 8], for example from :func:`material_params`.
        material: Row of each particle, int32 [N], or None.
        body: Velocity field of each particle, int32 [N]; with it and ``fields`` > 1, contact.
        fields: Number of velocity fields.
        gravity: Acceleration [m/s^2].
        colliders: Rows of :func:`gsfluent.ops.grid_update`.
        friction: Coulomb coefficient between fields.
        restitution: Between fields, in [0, 1].
        contact_gap: See :func:`gsfluent.ops.grid_update`.
        **return_map: ``k``, ``epsilon``, ``implicit`` of :func:`gsfluent.ops.return_mapping`.

    Returns:
        The state ``dt`` later. A particle the grid cannot hold (not finite) is refused.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device, range, law, parameter or row is wrong; a position is not
            finite.

    Gradient: every floating tensor but ``colliders``, see docs/theory/gradients.md. Deterministic
    on the CPU.
    """
    contact = fields > 1
    blocks = build_blocks(state.position, dx)
    grid, moments = p2g(
        state.position,
        state.velocity,
        state.affine,
        mass,
        dx=dx,
        blocks=blocks,
        dt=dt,
        stress=state.stress,
        volume=volume,
        body=body,
        fields=fields,
        contact=contact,
    )
    field, _, _ = grid_update(
        grid,
        dx=dx,
        dt=dt,
        blocks=blocks,
        gravity=gravity,
        colliders=colliders,
        moments=moments,
        friction=friction,
        restitution=restitution,
        contact_gap=contact_gap,
    )
    position, velocity, affine, _ = g2p(
        field, state.position, dx=dx, dt=dt, blocks=blocks, body=body, velocity=state.velocity
    )
    strain, alpha, stress, _ = return_mapping(
        state.strain,
        state.alpha,
        dt * affine,
        law=law,
        params=params,
        material=material,
        dt=dt,
        **return_map,
    )
    return MpmState(position, velocity, affine, strain, alpha, stress)


def rollout(
    state: MpmState, steps: int, *, checkpoint_every: int | None = None, **options: Any
) -> MpmState:
    """Many steps, with a memory for the backward pass that grows with the square root of them.

    Args:
        state: From :func:`mpm_state` or an earlier rollout.
        steps: Number of steps.
        checkpoint_every: Steps between the states that are kept; those between are computed again
            in the backward pass, one such stretch at a time. Kept at once: ``steps /
            checkpoint_every`` states and what ``checkpoint_every`` steps save. None takes the
            square root of ``steps``; 0 keeps everything and computes nothing twice.
        **options: Everything else of :func:`mpm_step`.

    Returns:
        The state after ``steps`` steps. For a trajectory call it once per observation.

    Raises:
        ValueError: ``steps`` or ``checkpoint_every`` is negative; see :func:`mpm_step`.
        TypeError: See :func:`mpm_step`.

    Gradient: as :func:`mpm_step`; the same to the last bit for every ``checkpoint_every`` on the
    CPU.
    """
    if steps < 0:
        raise ValueError(f"rollout: steps must be >= 0, got {steps}")
    if checkpoint_every is None:
        checkpoint_every = math.isqrt(max(steps - 1, 0)) + 1
    if checkpoint_every < 0:
        raise ValueError(f"rollout: checkpoint_every must be >= 0, got {checkpoint_every}")

    def stretch(count: int, *fields: Tensor) -> MpmState:
        now = MpmState(*fields)
        for _ in range(count):
            now = mpm_step(now, **options)
        return now

    if checkpoint_every == 0 or not torch.is_grad_enabled():
        return stretch(steps, *state)
    for begin in range(0, steps, checkpoint_every):
        count = min(checkpoint_every, steps - begin)
        state = checkpoint(stretch, count, *state, use_reentrant=False, preserve_rng_state=False)
    return state
