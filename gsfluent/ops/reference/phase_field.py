"""The phase-field law of one point in plain PyTorch (docs/theory/phase-field.md).

The kernels have it in ``csrc/core/material/phase_field.h``. The damage of a point comes with its
row, in the column ``cohesion``; the field it belongs to is solved in
:mod:`gsfluent.ops.reference.damage`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.materials.phase_field import C0, SPLITS
from gsfluent.ops.reference.laws import Returned
from gsfluent.ops.reference.nacc import Material
from gsfluent.ops.reference.tensors import (
    EIGEN_BATCH,
    det_minus_one,
    deviator,
    diagonal,
    safe_norm,
    spectral,
    strain_from_isochoric,
    to_matrix,
    unit_det_shift,
)

PHASE = 9
RESIDUAL = 1e-4
"""Stiffness that is left where d = 1, k."""
BROKEN = 0.95
"""Damage of a broken point."""
DRIVE_MAX = 1e4
"""Largest history over the threshold that is kept."""
EMPTY = 2.0**-24
"""Volume below which a node is empty, over that of the largest point (``kEmptyNode``)."""
VOLUME_MAX, SHEAR_MAX = 0.44, 0.5
"""What broken matter remembers of its opening, J^2 - 1, and of its shear, |d|."""


def degradation(damage: Tensor) -> Tensor:
    """Share of psi+ that is left, g(d)."""
    return (1.0 - RESIDUAL) * (1.0 - damage) ** 2 + RESIDUAL


def drive_threshold(toughness: Tensor, length: Tensor, model: str) -> Tensor:
    """psi+ below which AT1 knows no damage, Gc / (2 c0 l) [J/m^3]; the unit of the history."""
    return toughness / (2.0 * C0[model] * length)


def bounded(d: Tensor, n: Tensor, j2m1: Tensor, m: Material) -> tuple[Tensor, Tensor, Tensor]:
    """(d, J^2 - 1, whether anything is forgotten) of broken matter that opened or sheared far."""
    broken = m.cohesion >= BROKEN
    far = broken & (j2m1 > VOLUME_MAX)
    # with a split by principal strains the others would be pressed as these are let go; squared
    # since d, which is no logarithm, falls more slowly than one
    principal = far & ((m.shear_damage.detach().long() & 3) >= SPLITS["spectral"])
    kept = (math.log1p(VOLUME_MAX) / torch.log1p(j2m1.clamp(min=VOLUME_MAX))) ** 2
    kept = torch.where(principal, kept, 1.0)
    d, n = kept[:, None] * d, kept * n
    sheared = broken & (n > SHEAR_MAX)
    d = torch.where(sheared, SHEAR_MAX / n.clamp(min=SHEAR_MAX), 1.0)[:, None] * d
    return d, torch.where(far, VOLUME_MAX, j2m1), far | sheared


def _invariants(strain: Tensor) -> tuple[Tensor, Tensor]:
    j2m1 = det_minus_one(to_matrix(strain))
    return torch.exp(-torch.log1p(j2m1) / 3.0)[:, None] * deviator(strain), j2m1


def _volume(x: Tensor) -> Tensor:
    """``x - ln(1 + x)`` for x = J^2 - 1."""
    small = x.abs() < 0.1
    near = torch.where(small, x, 0.0)
    series = torch.full_like(x, 1.0 / 16.0)
    for n in range(15, 1, -1):
        series = 1.0 / n - near * series
    far = torch.where(small, 1.0, x)
    return torch.where(small, near**2 * series, far - torch.log1p(far))


def split_energy(strain: Tensor, m: Material) -> tuple[Tensor, Tensor]:
    """(psi+, psi-) [J/m^3], [N] each; only psi+ loses stiffness."""
    split = m.shear_damage.detach().long() & 3
    d, j2m1 = _invariants(strain)
    shear = 1.5 * m.mu * unit_det_shift(d)
    open_, pressed = (0.25 * m.kappa * _volume(x) for x in (j2m1.clamp(min=0), j2m1.clamp(max=0)))
    none = split == SPLITS["none"]
    plus = shear + open_ + torch.where(none, pressed, 0.0)
    minus = torch.where(none, 0.0, pressed)
    principal = split >= SPLITS["spectral"]
    if bool(principal.any()):
        up, down, log_j = _principal(strain)
        lame = 0.5 * (m.kappa - 2.0 / 3.0 * m.mu)
        up, down = (m.mu * safe_norm(h) ** 2 for h in (up, down))
        plus = torch.where(principal, up + lame * log_j.clamp(min=0) ** 2, plus)
        minus = torch.where(principal, down + lame * log_j.clamp(max=0) ** 2, minus)
    return plus, minus


def drive(strain: Tensor, m: Material) -> Tensor:
    """What drives damage [J/m^3], [N]: psi+, or by ``rankine`` the largest tensile stress."""
    found = split_energy(strain, m)[0]
    rankine = (m.shear_damage.detach().long() & 3) == SPLITS["rankine"]
    if bool(rankine.any()):
        log_v = spectral(strain, "log")
        largest = torch.cat(
            [torch.linalg.eigvalsh(m)[:, -1] for m in to_matrix(log_v).split(EIGEN_BATCH)]
        )
        log_j = log_v[:, :3].sum(1)
        # what it bears, over g: what is pressed loses no stiffness
        volume = log_j.clamp(min=0.0) + log_j.clamp(max=0.0) / degradation(m.cohesion)
        pull = (m.kappa - 2.0 / 3.0 * m.mu) * volume + 2.0 * m.mu * largest
        young = 9.0 * m.kappa * m.mu / (3.0 * m.kappa + m.mu)
        found = torch.where(rankine, 0.5 * pull.clamp(min=0.0) ** 2 / young, found)
    return found


def _principal(strain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Positive and negative part of the Hencky strain, and its trace."""
    up = spectral(strain, "tension")
    log_v = spectral(strain, "log")
    return up, log_v - up, log_v[:, :3].sum(1)


def phase_field(
    strain: Tensor, d: Tensor, n: Tensor, j2m1: Tensor, guarded: Tensor, alpha: Tensor, m: Material
) -> Returned:
    """Stress of a trial state and the history after it; arguments are those of a trial."""
    d, j2m1, forgets = bounded(d, n, j2m1, m)
    rebuilt = strain_from_isochoric(d, 0.5 * torch.log1p(j2m1))
    strain = torch.where((guarded | forgets)[:, None], rebuilt, strain)
    g = degradation(m.cohesion)
    split = m.shear_damage.detach().long() & 3
    open_, pressed = j2m1.clamp(min=0.0), j2m1.clamp(max=0.0)
    pull = torch.where(split == SPLITS["none"], g * (open_ + pressed), g * open_ + pressed)
    stress = (g * m.mu)[:, None] * d + diagonal(0.5 * m.kappa * pull)
    principal = split >= SPLITS["spectral"]
    if bool(principal.any()):
        up, down, log_j = _principal(strain)
        lame = m.kappa - 2.0 / 3.0 * m.mu
        own = 2.0 * m.mu[:, None] * (g[:, None] * up + down)
        own = own + diagonal(lame * (g * log_j.clamp(min=0.0) + log_j.clamp(max=0.0)))
        stress = torch.where(principal[:, None], own, stress)
    now = drive(strain, m) / m.friction.clamp(min=1e-30)
    alpha = torch.maximum(alpha, now.clamp(max=DRIVE_MAX) - 1.0)
    return Returned(strain, alpha, stress, forgets, guarded)


def energy(strain: Tensor, m: Material) -> Tensor:
    """Stored energy per initial volume, g psi+ + psi- [J/m^3], [N]."""
    plus, minus = split_energy(strain, m)
    return degradation(m.cohesion) * plus + minus
