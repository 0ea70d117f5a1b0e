"""Viscosity of solids: a share of the stiffness that relaxes, and a yield that takes time.

Composed of :func:`gsfluent.ops.return_mapping`; the resident solver has it in one kernel
(``csrc/core/material/viscous.h``). Equations: docs/theory/viscous.md.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from gsfluent._check import check_tensor
from gsfluent.ops.plasticity import INSTANT, LAWS, elastic_energy, return_mapping

SHARE, RATE, TIME = 6, 7, 8
"""Columns of ``viscous`` after the strain of the spring: share g of the stiffness, 1 / tau, T."""


def check_viscous(op: str, viscous: Tensor, like: Tensor) -> None:
    """Refuse viscosity that is none.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape or device; a share outside 0 to 1, a time below 0, values that are
            not finite.
    """
    check_tensor(op, "viscous", viscous, shape=(like.shape[0], 9), like=like)
    share, time = viscous[:, SHARE], viscous[:, TIME]
    good = torch.isfinite(viscous).all(dim=1) & (share >= 0) & (share <= 1) & (time >= 0)
    if not bool(good.all()):
        row = int((~good).nonzero()[0])
        raise ValueError(
            f"{op}: viscous must be finite, with a share of 0 to 1 and a time of 0 or more, "
            f"got {viscous[row, SHARE:].tolist()} in row {row}"
        )


_plain: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def _elastic(law: Tensor, params: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of the neo-Hookean law with the stiffness of these, made and checked once a table."""
    known = None if params.is_inference() else _plain.get(params)
    if known is not None and known[0] == params._version:
        return known[1]
    plain = torch.zeros_like(params)
    plain[:, :2], plain[:, 6] = params[:, :2], params[:, 6]
    rows = torch.full_like(law, LAWS["elastic"]), plain
    if not (params.is_inference() or params.requires_grad):
        _plain[params] = params._version, rows
    return rows


def _kept_by_unloading(
    rate: Tensor, stress: Tensor, increment: Tensor, modulus: Tensor, dt: float
) -> Tensor:
    """Share of the spring that what springs back leaves; 1 where ``rate`` is not negative."""
    moved = (increment + increment.transpose(1, 2)).flatten(1)[:, [0, 4, 8, 1, 2, 5]]
    moved = torch.cat([0.5 * moved[:, :3], moved[:, 3:]], dim=1)
    work = (stress * moved).sum(dim=1, keepdim=True)
    slow = (-rate * dt).clamp(min=1e-30) * (_norm2(stress) + 1e-6)
    kept = 1.0 - (-work * modulus / slow - 1.0).clamp(0.0, 1.0)
    return torch.where(rate < 0, kept, 1.0)


def viscous_step(
    viscous: Tensor,
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    returned: tuple[Tensor, Tensor, Tensor],
    *,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    dt: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What viscosity makes of the step of a law: a yield that takes time, a spring that relaxes.

    A yield goes ``dt / (T + dt)`` of the way that the law says (Duvaut and Lions 1976). The spring
    of the Maxwell branch relaxes for half of the step, goes along with ``increment``, and relaxes
    for the rest (second order in dt / tau). Of brittle matter it goes back onto the yield surface
    as a state of the law would, and moves it no further. Both are stable for any step. Simo and
    Hughes 1998, ch. 2.7 and 10.

    Args:
        viscous: Of each point, [N, 9]: strain of its spring (as ``strain``), its share g of the
            stiffness, 0 to 1, its rate of relaxation 1 / tau [1/s], and the time T of a yield [s],
            0 for at once. A negative rate: it does not relax, but is let go by what springs back
            faster than -rate, and a landing returns 1 - g of its energy (Walton and Braun 1986).
        strain: Strain of the law before the step, [N, 6].
        alpha: Its alpha before the step, [N].
        increment: ``dt grad v``, [N, 3, 3].
        returned: Strain, alpha and Kirchhoff stress [Pa] that :func:`return_mapping` made of them.
        law: Law of each row, int32 [M]; 0 (elastic) and 1 (nacc) are the ones that make sense.
        params: Parameters of each row, [M, 8].
        material: Row of each point, int32 [N]; as in :func:`return_mapping`.
        dt: Step [s]; 0 asks for the stress of a state as it is.

    Returns:
        After the step: ``viscous`` [N, 9], strain [N, 6], alpha [N], and the stress ``(1 - g)
        stress + g spring`` [N, 6].

    Raises:
        TypeError, ValueError: As :func:`check_viscous` and :func:`return_mapping`.
    """
    check_viscous("viscous_step", viscous, strain)
    share, rate, time = (viscous[:, c, None] for c in (SHARE, RATE, TIME))
    still, none = strain.new_zeros(strain.shape[0]), torch.zeros_like(increment)
    plain_law, plain = _elastic(law, params)

    def elastic(e: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
        strain, _, stress, _ = return_mapping(
            e, still, moved, law=plain_law, params=plain, material=material, dt=INSTANT
        )
        return strain, stress

    after, new_alpha, stress = returned
    way = torch.ones_like(share)
    brittle = bool((law == LAWS["nacc"]).any())
    if brittle:
        trial, trial_stress = elastic(strain, increment)
        way = torch.where(time > 0, dt / (time + dt).clamp(min=1e-30), 1.0)
        late = (stress != trial_stress).any(dim=1, keepdim=True) & (time > 0)
        slow, slow_stress = elastic((1.0 - way) * trial + way * after, none)
        after, stress = torch.where(late, slow, after), torch.where(late, slow_stress, stress)
        slow_alpha = alpha + way[:, 0] * (new_alpha - alpha)
        new_alpha = torch.where(late[:, 0], slow_alpha, new_alpha)
    row = params if material is None else params[material.long()]
    modulus = row[:, 1:2] + 4.0 / 3.0 * row[:, :1]
    y = 0.5 * dt * rate.clamp(min=0.0)
    half = 1.0 / (1.0 + y * (1.0 + 0.5 * y))
    left = _kept_by_unloading(rate, stress, increment, modulus, dt)
    spring = left * half * elastic(half * viscous[:, :6], increment)[0]
    spring, held = elastic(spring, none)
    if brittle:  # onto the surface where it is, which stays there
        inside, _, inside_stress, _ = return_mapping(
            spring, new_alpha, none, law=law, params=params, material=material, implicit=False,
            dt=INSTANT,
        )  # fmt: skip
        beyond = (inside_stress != held).any(dim=1, keepdim=True)
        back, back_stress = elastic((1.0 - way) * spring + way * inside, none)
        spring, held = torch.where(beyond, back, spring), torch.where(beyond, back_stress, held)
    spring = torch.where(share > 0, spring, viscous[:, :6])
    stress = torch.where(share > 0, (1.0 - share) * stress + share * held, stress)
    return torch.cat([spring, viscous[:, SHARE:]], dim=1), after, new_alpha, stress


def viscous_energy(
    viscous: Tensor, energy: Tensor, *, law: Tensor, params: Tensor, material: Tensor | None = None
) -> Tensor:
    """Energy stored by viscous points per initial volume [J/m^3], [N].

    Args:
        viscous: Of each point, [N, 9]; see :func:`viscous_step`.
        energy: What :func:`gsfluent.ops.elastic_energy` says of the law's strain, [N].
        law: Law of each row, int32 [M].
        params: Parameters of each row, [M, 8].
        material: Row of each point, int32 [N].
    """
    plain_law, plain = _elastic(law, params)
    spring = elastic_energy(
        viscous[:, :6].contiguous(), law=plain_law, params=plain, material=material
    )
    share = viscous[:, SHARE]
    return (1.0 - share) * energy + share * spring


def _norm2(stress: Tensor) -> Tensor:
    """Square of the size of symmetric tensors, [N, 1]."""
    square = stress.square()
    return square[:, :3].sum(dim=1, keepdim=True) + 2.0 * square[:, 3:].sum(dim=1, keepdim=True)
