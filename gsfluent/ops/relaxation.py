"""A Maxwell branch beside a law: a share of the stiffness that relaxes.

Composed of :func:`gsfluent.ops.return_mapping`; the resident solver has it in one kernel
(``csrc/core/material/relaxation.h``). Equations: docs/theory/relaxation.md.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops.plasticity import INSTANT, LAWS, elastic_energy, return_mapping

SHARE, RATE = 6, 7
"""Columns of ``maxwell`` after the strain of the spring: share g of the stiffness, 1 / tau."""


def check_maxwell(op: str, maxwell: Tensor, like: Tensor) -> None:
    """Refuse branches that are none.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape or device; a share outside 0 to 1, a rate below 0, values that are
            not finite.
    """
    check_tensor(op, "maxwell", maxwell, shape=(like.shape[0], 8), like=like)
    share, rate = maxwell[:, SHARE], maxwell[:, RATE]
    good = torch.isfinite(maxwell).all(dim=1) & (share >= 0) & (share <= 1) & (rate >= 0)
    if not bool(good.all()):
        row = int((~good).nonzero()[0])
        raise ValueError(
            f"{op}: maxwell must be finite, with a share of 0 to 1 and a rate of 0 or more, got "
            f"share {float(share[row]):g}, rate {float(rate[row]):g} in row {row}"
        )


def _elastic(law: Tensor, params: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of the neo-Hookean law with the stiffness of these."""
    plain = torch.zeros_like(params)
    plain[:, :2], plain[:, 6] = params[:, :2], params[:, 6]
    return torch.full_like(law, LAWS["elastic"]), plain


def maxwell_step(
    maxwell: Tensor,
    strain: Tensor,
    increment: Tensor,
    stress: Tensor,
    *,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    dt: float,
) -> tuple[Tensor, Tensor]:
    """Carry Maxwell branches through a step and let their springs share in the stress.

    The spring relaxes for half of the step, goes along with ``increment``, and relaxes for the
    rest (second order in dt / tau, stable for any). Where the law yields, it keeps as much of its
    strain as the law of its stress. Simo and Hughes 1998, ch. 10; Reese and Govindjee 1998.

    Args:
        maxwell: Branch of each point, [N, 8]: strain of its spring (as ``strain``), its share g of
            the stiffness, 0 to 1, and its rate of relaxation 1 / tau [1/s].
        strain: Strain of the law before the step, [N, 6].
        increment: ``dt grad v``, [N, 3, 3].
        stress: Kirchhoff stress [Pa] that :func:`return_mapping` made of the two, [N, 6].
        law: Law of each row, int32 [M]; 0 (elastic) and 1 (nacc) are the ones that make sense.
        params: Parameters of each row, [M, 8].
        material: Row of each point, int32 [N]; as in :func:`return_mapping`.
        dt: Step [s]; 0 leaves the branches as they are.

    Returns:
        The branches after the step, [N, 8], and the stress ``(1 - g) stress + g spring``, [N, 6].

    Raises:
        TypeError, ValueError: As :func:`check_maxwell` and :func:`return_mapping`.
    """
    check_maxwell("maxwell_step", maxwell, strain)
    share, rate = maxwell[:, SHARE, None], maxwell[:, RATE, None]
    still, none = strain.new_zeros(strain.shape[0]), torch.zeros_like(increment)
    plain_law, plain = _elastic(law, params)

    def elastic(e: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
        strain, _, stress, _ = return_mapping(
            e, still, moved, law=plain_law, params=plain, material=material, dt=INSTANT
        )
        return strain, stress

    y = 0.5 * dt * rate
    half = 1.0 / (1.0 + y * (1.0 + 0.5 * y))
    spring = elastic(half * maxwell[:, :6], increment)[0]
    spring = half * spring
    if bool((law == LAWS["nacc"]).any()):
        trial = elastic(strain, increment)[1]
        left = _norm2(stress) / _norm2(trial).clamp(min=1e-30)
        yields = (stress != trial).any(dim=1, keepdim=True)
        spring = torch.where(yields, left.sqrt().clamp(max=1.0) * spring, spring)
    spring, held = elastic(spring, none)
    spring = torch.where(share > 0, spring, maxwell[:, :6])
    mixed = torch.where(share > 0, (1.0 - share) * stress + share * held, stress)
    return torch.cat([spring, maxwell[:, SHARE:]], dim=1), mixed


def maxwell_energy(
    maxwell: Tensor, energy: Tensor, *, law: Tensor, params: Tensor, material: Tensor | None = None
) -> Tensor:
    """Energy stored by points with Maxwell branches per initial volume [J/m^3], [N].

    Args:
        maxwell: Branch of each point, [N, 8]; see :func:`maxwell_step`.
        energy: What :func:`gsfluent.ops.elastic_energy` says of the law's strain, [N].
        law: Law of each row, int32 [M].
        params: Parameters of each row, [M, 8].
        material: Row of each point, int32 [N].
    """
    plain_law, plain = _elastic(law, params)
    spring = elastic_energy(
        maxwell[:, :6].contiguous(), law=plain_law, params=plain, material=material
    )
    share = maxwell[:, SHARE]
    return (1.0 - share) * energy + share * spring


def _norm2(stress: Tensor) -> Tensor:
    """Square of the size of symmetric tensors, [N, 1]."""
    square = stress.square()
    return square[:, :3].sum(dim=1, keepdim=True) + 2.0 * square[:, 3:].sum(dim=1, keepdim=True)
