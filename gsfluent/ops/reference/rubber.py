"""Yeoh's and Ogden's rubber in plain PyTorch: the definition of csrc/core/material/more_laws.h.

Isochoric stretches l_i, x = l_1^2 + l_2^2 + l_3^2 - 3, and the volumetric part of the neo-Hookean
law. Sources: Yeoh, Rubber Chem. Technol. 66 (1993) 754; Ogden, Proc. R. Soc. A 326 (1972) 565.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.reference.laws import Returned
from gsfluent.ops.reference.nacc import Material
from gsfluent.ops.reference.tensors import (
    det_minus_one,
    deviator,
    diagonal,
    safe_norm,
    spectral,
    to_matrix,
    unit_det_shift,
)

YEOH, OGDEN = 7, 8


def _isochoric(e: Tensor, log_j: Tensor) -> tuple[Tensor, Tensor]:
    """(d, x): J^(-2/3) dev b, [N, 6], and J^(-2/3) tr b - 3, [N]."""
    d = torch.exp(-2.0 / 3.0 * log_j)[:, None] * deviator(e)
    return d, 3.0 * unit_det_shift(d)


def yeoh(e: Tensor, log_j: Tensor, guarded: Tensor, alpha: Tensor, m: Material) -> Returned:
    """Stress (mu + 4 C20 x + 6 C30 x^2) d + kappa/2 (J^2 - 1) I; C20, C30 in columns 2 and 3."""
    d, x = _isochoric(e, log_j)
    slope = m.mu + 4.0 * m.friction * x + 6.0 * m.cohesion * x * x
    stress = slope[:, None] * d + diagonal(0.5 * m.kappa * torch.expm1(2.0 * log_j))
    return Returned(e, alpha, stress, torch.zeros_like(guarded), guarded)


def ogden_terms(m: Material) -> list[tuple[Tensor, Tensor]]:
    """(mu_p, alpha_p) of the three terms; mu_1 from 2 mu = sum of mu_p alpha_p."""
    rest = m.cohesion * m.hardening + m.shear_damage * m.exponent
    first = (2.0 * m.mu - rest) / m.friction
    return [(first, m.friction), (m.cohesion, m.hardening), (m.shear_damage, m.exponent)]


def ogden(e: Tensor, log_j: Tensor, guarded: Tensor, alpha: Tensor, m: Material) -> Returned:
    """Stress dev(sum of mu_p V^alpha_p) + kappa/2 (J^2 - 1) I of the isochoric V."""
    dev = deviator(spectral(e, "log"))
    stress = diagonal(0.5 * m.kappa * torch.expm1(2.0 * log_j))
    for modulus, power in ogden_terms(m):
        stress = stress + modulus[:, None] * deviator(spectral(power[:, None] * dev, "exp"))
    return Returned(e, alpha, stress, torch.zeros_like(guarded), guarded)


LAWS = {YEOH: yeoh, OGDEN: ogden}


def energy(number: int, strain: Tensor, m: Material) -> Tensor:
    """Stored energy per initial volume [J/m^3], [N]."""
    j2m1 = det_minus_one(to_matrix(strain))
    log_j = 0.5 * torch.log1p(j2m1)
    volumetric = 0.25 * m.kappa * (j2m1 - 2.0 * log_j)
    if number == YEOH:
        x = _isochoric(strain, log_j)[1]
        return x * (0.5 * m.mu + x * (m.friction + x * m.cohesion)) + volumetric
    dev = deviator(spectral(strain, "log"))
    total = volumetric
    for modulus, power in ogden_terms(m):
        grown = spectral(power[:, None] * dev, "exp")[:, :3].sum(1)
        total = total + modulus / torch.where(modulus == 0, 1.0, power) * grown
    return total


def wave_modulus(number: int, strain: Tensor, j2m1: Tensor, log_j: Tensor, m: Material) -> Tensor:
    """Density times the square of the fastest wave speed [Pa], [N]."""
    volumetric = 0.5 * m.kappa * (2.0 + j2m1)
    d, x = _isochoric(strain, log_j)
    if number == YEOH:
        n, root = safe_norm(d), (2.0 / 3.0) ** 0.5
        mu = (m.mu + 4.0 * m.friction * x + 6.0 * m.cohesion * x * x).clamp(min=0.0)
        bend = (8.0 * m.friction + 24.0 * m.cohesion * x).clamp(min=0.0)
        mean = 1.0 + x / 3.0
        along = mu * (4.0 / 3.0 * mean + root / 3.0 * n) + bend * (2.0 / 3.0) * n * n + volumetric
        return torch.maximum(along, mu * (mean + root * n))
    b = torch.linalg.eigvalsh(to_matrix(strain))
    h = 0.5 * torch.log1p(b.clamp(min=-0.9999)) - log_j[:, None] / 3.0
    square = torch.exp(2.0 * h)
    stress, slope = torch.zeros_like(h), torch.zeros_like(h)
    for modulus, power in ogden_terms(m):
        grown = torch.expm1(power[:, None] * h)
        stress = stress + modulus[:, None] * grown
        slope = slope + (modulus * power)[:, None] * (1.0 + grown)
    least = (stress - stress.mean(1, keepdim=True)).amin(1).clamp(max=0.0)
    most = slope.amax(1) / 3.0 + slope.sum(1) / 9.0 - least + volumetric
    for i, j in ((0, 1), (0, 2), (1, 2)):
        gap = square[:, i] - square[:, j]
        equal = gap.abs() < 1e-3 * square[:, j]
        ratio = (stress[:, i] - stress[:, j]) / torch.where(equal, 1.0, gap)
        ratio = ratio * torch.maximum(square[:, i], square[:, j])
        mean = 0.5 * torch.maximum(slope[:, i], slope[:, j])
        most = torch.maximum(most, torch.where(equal, mean, ratio))
    return most
