"""The constitutive step in plain PyTorch: the definition of ``return_mapping``, and its gradient.

Differentiable with respect to strain, alpha, increment and params. The laws beside neo-Hookean and
NACC are in :mod:`gsfluent.ops.reference.laws` and :mod:`gsfluent.ops.reference.rubber`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.ops.reference import laws as other
from gsfluent.ops.reference import phase_field as phase
from gsfluent.ops.reference import rubber
from gsfluent.ops.reference.nacc import (
    ALPHA_MAX,
    ALPHA_MIN,
    Material,
    Options,
    alpha_step,
    normalized,
    project,
    solve_alpha,
    yield_surface,
)
from gsfluent.ops.reference.rankine import rankine
from gsfluent.ops.reference.tensors import (
    det_minus_one,
    diagonal,
    safe_norm,
    strain_from_isochoric,
    to_matrix,
    to_sym,
    unit_det_shift,
)

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "Material",
    "Options",
    "elastic_energy",
    "gather_material",
    "neo_hookean_energy",
    "normalized",
    "of_other_laws",
    "return_mapping",
    "strain_from_isochoric",
    "to_matrix",
    "to_sym",
    "unit_det_shift",
    "wave_speed_squared",
    "yield_surface",
]

J_MIN, J_MAX, DEVIATOR_MAX, STRAIN_MAX = 0.05, 20.0, 100.0, 1e4


def gather_material(params: Tensor, rows: Tensor | None, count: int) -> Material:
    """Per-particle columns of ``params`` [M, 8]; ``rows`` is the material index or None."""
    index = rows.long() if rows is not None else None
    table = params[index] if index is not None else params.expand(count, -1)
    return Material(*table.unbind(1))


def _gather_law(law: Tensor, rows: Tensor | None, count: int) -> Tensor:
    return law[rows.long()] if rows is not None else law.expand(count)


class Trial(NamedTuple):
    """Guarded trial state (csrc/core/material/elastic.h); ``e`` is the strain before any pull."""

    e: Tensor
    d: Tensor
    n: Tensor
    j2m1: Tensor
    log_j: Tensor
    guarded: Tensor


def _trial(e: Tensor, inverted: Tensor) -> Trial:
    largest = e.abs().amax(1)
    too_large = largest > STRAIN_MAX
    e = torch.where(too_large, STRAIN_MAX / largest.clamp(min=STRAIN_MAX), 1.0)[:, None] * e
    lo, hi = J_MIN**2 - 1.0, J_MAX**2 - 1.0
    raw = torch.where(inverted, lo, det_minus_one(to_matrix(e)))
    came_with = raw.clamp(min=lo)
    j2m1 = came_with.clamp(max=hi)
    isochoric = torch.exp(-torch.log1p(came_with) / 3.0)
    log_j = 0.5 * torch.log1p(j2m1)
    d = isochoric[:, None] * (e - diagonal(e[:, :3].mean(1)))
    n = safe_norm(d)
    too_sheared = n > DEVIATOR_MAX
    d = torch.where(too_sheared, DEVIATOR_MAX / n.clamp(min=DEVIATOR_MAX), 1.0)[:, None] * d
    n = n.clamp(max=DEVIATOR_MAX)
    guarded = inverted | too_large | (raw < lo) | (raw > hi) | too_sheared
    return Trial(e, d, n, j2m1, log_j, guarded)


def _neo_hookean(
    t: Trial,
    alpha: Tensor,
    m: Material,
    o: Options,
    nacc: Tensor,
    valid: Tensor,
    root: Tensor | None,
) -> other.Returned:
    """Laws 0 and 1 (csrc/core/material/nacc.h)."""
    d, j2m1, log_j = t.d, t.j2m1, t.log_j
    p, q = -0.5 * m.kappa * j2m1, 1.5**0.5 * m.mu * t.n
    alpha = torch.where(nacc & valid, alpha.clamp(ALPHA_MIN, ALPHA_MAX), alpha)
    cut = nacc & (m.shear_damage < 0.0)
    started = alpha
    u, w = normalized(m, alpha, p, q)
    slack = 2e-15 if d.dtype == torch.float64 else 1e-6
    plastic = valid & nacc & ~cut & (u**2 + w**2 > 1.0 + slack)
    if o.implicit:
        new_alpha = solve_alpha(m, o, log_j, t.n, p, q, alpha, root)
        if root is not None:  # at a limit it moves no further
            new_alpha = torch.where((root > ALPHA_MIN) & (root < ALPHA_MAX), new_alpha, root)
        new_alpha = new_alpha.clamp(ALPHA_MIN, ALPHA_MAX)
        _, p_new, r = project(m, o, new_alpha, p, q)
    else:
        cross, p_new, r = project(m, o, alpha, p, q)
        new_alpha = (alpha + alpha_step(m, log_j, t.n, cross, r)).clamp(ALPHA_MIN, ALPHA_MAX)
    alpha = torch.where(plastic, new_alpha, alpha)
    d = torch.where(plastic[:, None], r[:, None] * d, d)
    j2m1 = torch.where(plastic, -2.0 * p_new / m.kappa, j2m1)
    log_j = torch.where(plastic, 0.5 * torch.log1p(j2m1), log_j)
    rows = (cut & valid).nonzero()[:, 0]
    if rows.numel():
        own = Material(*(column[rows] for column in m))
        found = rankine(t.d[rows], t.j2m1[rows], started[rows], own, o.implicit)
        d, j2m1 = d.index_copy(0, rows, found[0]), j2m1.index_copy(0, rows, found[1])
        alpha, plastic = alpha.index_copy(0, rows, found[2]), plastic.index_copy(0, rows, found[3])
        log_j = torch.where(plastic, 0.5 * torch.log1p(j2m1), log_j)
    rebuilt = (plastic | t.guarded)[:, None]
    strain = torch.where(rebuilt, strain_from_isochoric(d, log_j), t.e)
    stress = m.mu[:, None] * d + diagonal(0.5 * m.kappa * j2m1)
    return other.Returned(strain, alpha, stress, plastic, t.guarded)


def return_mapping(
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    *,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    k: float = 2.0,
    epsilon: float = 0.1,
    implicit: bool = True,
    dt: float = 0.0,
    root: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One constitutive step; arguments and results as :func:`gsfluent.ops.return_mapping`.

    ``root``, [N], is the implicit alpha when it is known already; only its derivative is computed.
    """
    count = strain.shape[0]
    m = gather_material(params, material, count)
    laws = _gather_law(law, material, count)
    o = Options(k, epsilon, implicit)

    # Lost states are replaced by rest before anything is differentiated.
    with torch.no_grad():
        h = increment + increment @ to_matrix(strain)
        e = strain + to_sym(h + h.transpose(1, 2) + h @ increment.transpose(1, 2))
        valid = torch.isfinite(e).all(1) & torch.isfinite(alpha)
    strain = torch.where(valid[:, None], strain, 0.0)
    increment = torch.where(valid[:, None, None], increment, 0.0)
    alpha_in, alpha = alpha, torch.where(torch.isfinite(alpha), alpha, 0.0)
    h = increment + increment @ to_matrix(strain)
    e = strain + to_sym(h + h.transpose(1, 2) + h @ increment.transpose(1, 2))
    inverted = valid & (laws != other.RIGID) & ~(1.0 + det_minus_one(increment) > 0)

    new_strain, stress = torch.zeros_like(e), torch.zeros_like(e)
    plastic, guarded = torch.zeros_like(valid), torch.zeros_like(valid)
    for number in laws.unique().tolist():
        if number == 1 and 0 in laws:  # neo-Hookean and NACC in one go
            continue
        rows = ((laws == number) | ((number == 0) & (laws == 1))).nonzero()[:, 0]
        own = Material(*(column[rows] for column in m))
        if number <= 1:
            t = _trial(e[rows], inverted[rows])
            known = None if root is None else root[rows]
            r = _neo_hookean(t, alpha[rows], own, o, laws[rows] == 1, valid[rows], known)
        elif number == other.RIGID:
            continue
        elif number == other.FLUID:
            r = other.fluid(strain[rows], alpha[rows], increment[rows], own, dt)
        else:
            t = _trial(e[rows], inverted[rows])
            pulled = strain_from_isochoric(t.d, t.log_j)
            kept = torch.where(t.guarded[:, None], pulled, t.e)
            state = kept, t.log_j, t.guarded, alpha[rows], own
            if number == phase.PHASE:
                r = phase.phase_field(t.e, t.d, t.n, t.j2m1, t.guarded, alpha[rows], own)
            elif number == other.METAL:
                r = other.von_mises(*state, dt)
            else:
                r = (other.LAWS | rubber.LAWS)[number](*state)
        new_strain = new_strain.index_copy(0, rows, r.strain)
        stress = stress.index_copy(0, rows, r.stress)
        alpha = alpha.index_copy(0, rows, r.alpha)
        plastic[rows], guarded[rows] = r.plastic, r.guarded
    new_strain = torch.where(valid[:, None], new_strain, 0.0)
    stress = torch.where(valid[:, None], stress, 0.0)
    alpha = torch.where(valid, alpha, torch.where(torch.isfinite(alpha_in), alpha_in, 0.0))
    flags = (plastic & valid, guarded & valid, inverted, ~valid)
    info = torch.stack([flag.sum() for flag in flags])
    return new_strain, alpha, stress, info.to(torch.int32)


def elastic_energy(strain: Tensor, m: Material, laws: Tensor | None = None) -> Tensor:
    """Stored energy per initial volume [J/m^3], [N]; ``laws`` [N], neo-Hookean where None."""
    energy = neo_hookean_energy(strain, m)
    return energy if laws is None else of_other_laws(energy, strain, m, laws)


def neo_hookean_energy(strain: Tensor, m: Material) -> Tensor:
    """Stored energy per initial volume [J/m^3] of the laws elastic and nacc, [N]."""
    x = det_minus_one(to_matrix(strain))
    log_j = 0.5 * torch.log1p(x)
    d = torch.exp(-2.0 / 3.0 * log_j)[:, None] * (strain - diagonal(strain[:, :3].mean(1)))
    series = x * x * (0.5 - x * (1.0 / 3.0 - x * (0.25 - x * 0.2)))
    volumetric = torch.where(x.abs() < 1e-3, series, x - 2.0 * log_j)
    return 1.5 * m.mu * unit_det_shift(d) + 0.25 * m.kappa * volumetric


def of_other_laws(energy: Tensor, strain: Tensor, m: Material, laws: Tensor) -> Tensor:
    """Energies [N] in which those of other laws than elastic and nacc are replaced by their own."""
    for number in laws.unique().tolist():
        if number > 1:
            rows = (laws == number).nonzero()[:, 0]
            own = Material(*(column[rows] for column in m))
            if number == phase.PHASE:
                found = phase.energy(strain[rows], own)
            else:
                of = rubber.energy if number in rubber.LAWS else other.energy
                found = of(number, strain[rows], own)
            energy = energy.index_copy(0, rows, found)
    return energy


def wave_speed_squared(strain: Tensor, m: Material, laws: Tensor) -> Tensor:
    """Square of the fastest wave speed [m^2/s^2], [N]: csrc/core/material/wave_speed.h."""
    finite = torch.isfinite(strain).all(1)
    strain = torch.where(finite[:, None], strain, 0.0)
    j2m1 = det_minus_one(to_matrix(strain)).clamp(J_MIN**2 - 1.0, J_MAX**2 - 1.0)
    log_j = 0.5 * torch.log1p(j2m1)
    third = strain[:, :3].mean(1)
    size = safe_norm(strain - diagonal(third)).clamp(max=STRAIN_MAX)
    isochoric = torch.exp(-2.0 / 3.0 * log_j)
    n = (isochoric * size).clamp(max=DEVIATOR_MAX)
    mean = (isochoric * (1.0 + third)).clamp(1.0, DEVIATOR_MAX)
    root = (2.0 / 3.0) ** 0.5
    along = m.mu * (4.0 / 3.0 * mean + root / 3.0 * n) + 0.5 * m.kappa * (2.0 + j2m1)
    modulus = torch.maximum(along, m.mu * (mean + root * n))
    hencky = m.kappa * (1.0 - log_j).clamp(min=0.0) + m.mu * (4.0 / 3.0 + n)
    modulus = torch.where((laws == other.SAND) | (laws == other.METAL), hencky, modulus)
    gamma = torch.where(m.exponent > 0, m.exponent, other.FLUID_EXPONENT)
    below = log_j.clamp(min=other.LOG_J_MIN, max=0.0)
    modulus = torch.where(laws == other.FLUID, m.kappa * torch.exp((1.0 - gamma) * below), modulus)
    largest = (1.0 + third + root * size).clamp(min=0.0)
    corotated = 2.0 * m.mu * largest + (m.kappa - 2.0 / 3.0 * m.mu) * (1.0 + j2m1)
    modulus = torch.where(laws == other.COROTATED, corotated, modulus)
    for number in set(laws.unique().tolist()) & set(rubber.LAWS):
        rows = (laws == number).nonzero()[:, 0]
        own = Material(*(column[rows] for column in m))
        found = rubber.wave_modulus(number, strain[rows], j2m1[rows], log_j[rows], own)
        modulus = modulus.index_copy(0, rows, found)
    return torch.where((laws == other.RIGID) | ~finite, 0.0, modulus / m.density)
