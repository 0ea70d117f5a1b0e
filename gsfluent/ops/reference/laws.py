"""The laws beside neo-Hookean and NACC in plain PyTorch, and their energies.

The kernels have them in ``csrc/core/material/laws.h``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.ops.reference.nacc import Material
from gsfluent.ops.reference.tensors import (
    det_minus_one,
    deviator,
    diagonal,
    safe_norm,
    spectral,
    to_matrix,
    to_sym,
)

SAND, METAL, FLUID, RIGID, COROTATED = 2, 3, 4, 5, 6
FLUID_EXPONENT, GAP_MAX = 7.0, 0.5
FLUID_J_MIN, FLUID_J_MAX, FLUID_STEPS = 0.6, 1.2, (0.8, 1.25)
LOG_J_MIN = math.log(FLUID_J_MIN)
_ROOT = (2.0 / 3.0) ** 0.5


class Returned(NamedTuple):
    """What a law makes of a trial state: [N, 6], [N], [N, 6], bool [N], bool [N]."""

    strain: Tensor
    alpha: Tensor
    stress: Tensor
    plastic: Tensor
    guarded: Tensor


def _slack(like: Tensor) -> float:
    return 1e-14 if like.dtype == torch.float64 else 4e-6


def _strain(dev: Tensor, log_j: Tensor) -> Tensor:
    s = torch.expm1(2.0 / 3.0 * log_j)
    return (1.0 + s)[:, None] * spectral(2.0 * dev, "exp") + diagonal(s)


def _stress(m: Material, dev: Tensor, log_j: Tensor) -> Tensor:
    return 2.0 * m.mu[:, None] * dev + diagonal(m.kappa * log_j)


def _mix(
    e: Tensor, dev: Tensor, log_j: Tensor, new_dev: Tensor, new_log_j: Tensor, plastic: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(strain, dev, ln J): the trial where elastic, rebuilt where plastic."""
    dev = torch.where(plastic[:, None], new_dev, dev)
    log_j = torch.where(plastic, new_log_j, log_j)
    return torch.where(plastic[:, None], _strain(dev, log_j), e), dev, log_j


def von_mises(
    e: Tensor, log_j: Tensor, guarded: Tensor, alpha: Tensor, m: Material, dt: float = 0.0
) -> Returned:
    """Radial return on ln V; alpha is the accumulated plastic strain.

    With a plastic viscosity eta (``shear_damage``) what is beyond the surface drives the flow: it
    is eta times the strain rate, over mu tr(b) / (3 mu) as PAC-NeRF has it. Softening (a negative
    modulus) ends with the yield stress at zero.
    """
    by_power = m.exponent > 0
    if bool(by_power.any()):
        rows = [by_power.nonzero()[:, 0], (~by_power).nonzero()[:, 0]]
        of = (_power_von_mises, von_mises)
        parts = [
            law(e[r], log_j[r], guarded[r], alpha[r], Material(*(c[r] for c in m)), dt)
            for law, r in zip(of, rows, strict=True)
        ]
        back = torch.argsort(torch.cat(rows))
        return Returned(*(torch.cat(both)[back] for both in zip(*parts, strict=True)))
    dev = deviator(spectral(e, "log"))
    n = safe_norm(dev)
    before = alpha.clamp(min=0.0)
    limit = _ROOT * (m.friction + m.hardening * before).clamp(min=0.0)
    trial = 2.0 * m.mu * n
    plastic = trial > limit + _slack(e) * (limit + 0.25 * m.mu * log_j.abs())
    drag = torch.zeros_like(n)
    viscous = m.shear_damage > 0
    if dt > 0.0:
        drag = torch.where(viscous, m.shear_damage / ((1.0 + e[:, :3].mean(1)) * dt), 0.0)
    else:
        plastic = plastic & ~viscous
    slip = (trial - limit) / (2.0 * m.mu + 2.0 / 3.0 * m.hardening + drag)
    spent = (m.hardening < 0) & (m.friction + m.hardening * (before + _ROOT * slip) < 0)
    slip = torch.where(spent, trial / (2.0 * m.mu + drag), slip)
    slip = torch.where(plastic, slip, 0.0)
    factor = (1.0 - slip / torch.where(plastic, n, 1.0)).clamp(min=0.0)
    strain, dev, log_j = _mix(e, dev, log_j, factor[:, None] * dev, log_j, plastic)
    return Returned(strain, before + _ROOT * slip, _stress(m, dev, log_j), plastic, guarded)


def power_yield(m: Material, strain: Tensor, rate: Tensor) -> Tensor:
    """Yield stress of Johnson and Cook [Pa] of plastic strains and rates [1/s], [N].

    ``(A + B a^n) (1 + C ln rate) exp(-W / Q)`` with the plastic work W of the strain at this rate:
    heat that stays, with the exponent of the temperature at 1.
    """
    some = torch.where(strain > 0, strain, 1.0)
    grown = torch.where(strain > 0, m.hardening * some**m.exponent, 0.0)
    faster = 1.0 + m.cohesion * torch.log(rate.clamp(min=1.0))
    hot = m.shear_damage > 0
    heat = torch.where(hot, m.shear_damage, 1.0)
    work = faster * strain * (m.friction + grown / (1.0 + m.exponent))
    return faster * (m.friction + grown) * torch.where(hot, torch.exp(-work / heat), 1.0)


def _power_slope(m: Material, strain: Tensor, slip: Tensor, dt: float) -> Tensor:
    """Growth of :func:`power_yield` with the strain of a step of length ``dt`` [Pa], [N]."""
    some = strain.clamp(min=1e-300)
    rate = (_ROOT * slip / dt if dt > 0.0 else torch.zeros_like(slip)).clamp(min=1.0)
    faster, bare = 1.0 + m.cohesion * torch.log(rate), m.friction + m.hardening * some**m.exponent
    cold = torch.where(m.shear_damage > 0, m.shear_damage, torch.inf)
    work = some * (m.friction + m.hardening * some**m.exponent / (1.0 + m.exponent)) * faster / cold
    along = m.hardening * m.exponent * some ** (m.exponent - 1.0) - faster * bare**2 / cold
    slope = faster * along
    if dt > 0.0:
        slope = slope + torch.where(rate > 1.0, m.cohesion / (rate * dt), 0.0) * bare * (1.0 - work)
    return torch.exp(-work) * slope


def _power_von_mises(
    e: Tensor, log_j: Tensor, guarded: Tensor, alpha: Tensor, m: Material, dt: float
) -> Returned:
    """Radial return to the surface of :func:`power_yield`, which moves with the flow.

    The flow is found by halving; one step of Newton's method then carries its derivative.
    """
    dev = deviator(spectral(e, "log"))
    n = safe_norm(dev)
    before = alpha.clamp(min=0.0)
    limit = _ROOT * power_yield(m, before, torch.zeros_like(n))
    trial = 2.0 * m.mu * n
    plastic = trial > limit + _slack(e) * (limit + 0.25 * m.mu * log_j.abs())
    if dt == 0.0:
        plastic = plastic & (m.cohesion == 0)

    def excess(x: Tensor) -> Tensor:
        rate = _ROOT * x / dt if dt > 0.0 else torch.zeros_like(x)
        return trial - 2.0 * m.mu * x - _ROOT * power_yield(m, before + _ROOT * x, rate)

    with torch.no_grad():
        low, high = torch.zeros_like(n), n.clone()
        for _ in range(120):
            middle = 0.5 * (low + high)
            more = excess(middle) > 0
            low, high = torch.where(more, middle, low), torch.where(more, high, middle)
    slip = high
    if torch.is_grad_enabled():
        off = excess(high)
        with torch.no_grad():
            falls = -2.0 * m.mu - 2.0 / 3.0 * _power_slope(m, before + _ROOT * high, high, dt)
        slip = high - (off - off.detach()) / falls
    slip = torch.where(plastic, slip, 0.0)
    factor = (1.0 - slip / torch.where(plastic, n, 1.0)).clamp(min=0.0)
    strain, dev, log_j = _mix(e, dev, log_j, factor[:, None] * dev, log_j, plastic)
    return Returned(strain, before + _ROOT * slip, _stress(m, dev, log_j), plastic, guarded)


def drucker_prager(
    e: Tensor, log_j: Tensor, guarded: Tensor, alpha: Tensor, m: Material
) -> Returned:
    """Cone with apex at ln J = c / kappa; alpha is the log volume opened in tension."""
    dev = deviator(spectral(e, "log"))
    n = safe_norm(dev)
    gap = alpha.clamp(0.0, GAP_MAX)
    apex = m.cohesion / m.kappa
    closing = torch.minimum((-log_j).clamp(min=0.0), gap)
    opened = (log_j + closing - apex).clamp(min=0.0)
    new_log_j = torch.minimum(log_j + closing, apex)
    limit = 1.5 * m.friction * m.kappa / m.mu * (apex - new_log_j)
    slides = n > limit + _slack(e) * (limit + new_log_j.abs())
    plastic = slides | (closing > 0) | (opened > 0)
    factor = torch.where(slides, limit / torch.where(slides, n, 1.0), 1.0)
    strain, dev, log_j = _mix(e, dev, log_j, factor[:, None] * dev, new_log_j, plastic)
    after = (gap - closing + opened).clamp(max=GAP_MAX)
    return Returned(strain, after, _stress(m, dev, log_j), plastic, guarded)


def corotated(e: Tensor, log_j: Tensor, guarded: Tensor, alpha: Tensor, m: Material) -> Returned:
    """Fixed corotated elasticity: 2 mu (b - V) + lambda J (J - 1) I."""
    lame = m.kappa - 2.0 / 3.0 * m.mu
    pressure = lame * torch.exp(log_j) * torch.expm1(log_j)
    stress = 2.0 * m.mu[:, None] * (e - spectral(e, "sqrt")) + diagonal(pressure)
    return Returned(e, alpha, stress, torch.zeros_like(guarded), guarded)


def fluid(strain: Tensor, alpha: Tensor, increment: Tensor, m: Material, dt: float) -> Returned:
    """Tait pressure without tension, Newtonian viscosity; the strain is (J^(2/3) - 1) I."""
    j2m1 = det_minus_one(to_matrix(strain)).clamp(min=-0.9999)
    x = strain[:, 0]
    same = (strain[:, 1] == x) & (strain[:, 2] == x) & (strain[:, 3:] == 0).all(1)
    by_volume = torch.expm1(torch.log1p(j2m1) / 3.0)
    # The value of an isotropic strain is x itself; its derivative is that of the volume.
    x = by_volume + torch.where(same, x - by_volume, 0.0).detach()
    growth = det_minus_one(increment)
    step = growth.clamp(FLUID_STEPS[0] - 1.0, FLUID_STEPS[1] - 1.0)
    x = x + (1.0 + x) * torch.expm1(2.0 / 3.0 * torch.log1p(step))
    lo, hi = FLUID_J_MIN ** (2.0 / 3.0) - 1.0, FLUID_J_MAX ** (2.0 / 3.0) - 1.0
    guarded, plastic = (step != growth) | (x < lo), x > hi
    x = x.clamp(lo, hi)
    log_j = 1.5 * torch.log1p(x)
    j = torch.exp(log_j)
    gamma = torch.where(m.exponent > 0, m.exponent, FLUID_EXPONENT)
    pressure = torch.where(x < 0, m.kappa / gamma * torch.expm1(-gamma * log_j), 0.0)
    stress = diagonal(-j * pressure)
    if dt > 0:
        spread = increment.diagonal(dim1=1, dim2=2).sum(1)
        rate = to_sym(increment + increment.mT) - diagonal(2.0 / 3.0 * spread)
        stress = stress + (j * m.friction / dt)[:, None] * rate
    return Returned(diagonal(x), alpha, stress, plastic, guarded)


LAWS = {SAND: drucker_prager, METAL: von_mises, COROTATED: corotated}


def energy(number: int, strain: Tensor, m: Material) -> Tensor:
    """Stored energy per initial volume [J/m^3], [N], of law ``number`` above 1."""
    if number == RIGID:
        return torch.zeros_like(m.mu)
    j2m1 = det_minus_one(to_matrix(strain))
    log_j = 0.5 * torch.log1p(j2m1)
    if number in (SAND, METAL):
        dev = deviator(spectral(strain, "log"))
        square = (dev[:, :3] ** 2).sum(1) + 2.0 * (dev[:, 3:] ** 2).sum(1)
        return m.mu * square + 0.5 * m.kappa * log_j**2
    if number == FLUID:
        gamma = torch.where(m.exponent > 0, m.exponent, FLUID_EXPONENT)
        below = log_j.clamp(max=0.0)
        one = gamma == 1.0
        bent = torch.where(one, 2.0, gamma) - 1.0
        term = torch.where(one, -below, torch.expm1(-bent * below) / bent)
        return m.kappa / gamma * (term + torch.expm1(below))
    stretch = spectral(strain, "sqrt")
    square = (stretch[:, :3] ** 2).sum(1) + 2.0 * (stretch[:, 3:] ** 2).sum(1)
    lame = m.kappa - 2.0 / 3.0 * m.mu
    return m.mu * square + 0.5 * lame * torch.expm1(log_j) ** 2
