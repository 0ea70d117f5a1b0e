"""Algorithm D on the deformation gradient, by singular values: an independent form of the same map.

Written step by step after equations.md section 5 in logarithmic stretches, sharing nothing with the
strain form: used to show that the two are equal where neither clamps.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.ops.reference.plasticity import Material


class SvdReturn(NamedTuple):
    """Returned left Cauchy-Green b [N, 3, 3], change of alpha [N], plastic or not [N]."""

    b: Tensor
    alpha_step: Tensor
    plastic: Tensor


def return_mapping_svd(
    deformation: Tensor, surface_alpha: Tensor, m: Material, *, k: float = 2.0, epsilon: float = 0.1
) -> SvdReturn:
    """Return trial deformation gradients to the yield surface of ``surface_alpha``.

    Args:
        deformation: Trial F, shape [N, 3, 3], float64.
        surface_alpha: Alpha that sets the surface, [N]: the old one for the explicit update, the
            new one to check an implicit result.
        m: Material columns per particle.
        k: Exponent of the dynamic centre.
        epsilon: Its regularisation.

    Returns:
        b' and the (unclamped by alpha's own range) change of alpha that this surface implies.
    """
    u_axes, sigma, _ = torch.linalg.svd(deformation)
    log_sigma = sigma.clamp(0.05, 20.0).log()
    log_j = log_sigma.sum(1)
    x = torch.expm1(2.0 * (log_sigma - log_j[:, None] / 3.0))
    d = x - x.mean(1, keepdim=True)
    n2 = (d * d).sum(1)
    q = 1.5**0.5 * m.mu * n2.sqrt()
    p = -0.5 * m.kappa * torch.expm1(2.0 * log_j)

    beta = m.cohesion.clamp(max=1e3)
    hard = (m.hardening * (-surface_alpha).clamp(min=0)).clamp(max=5.0)
    p0 = torch.minimum(m.kappa * (1e-5 + torch.sinh(hard)), 0.5 * m.kappa * (1 - 0.1**2))
    a, pc = 0.5 * (1 + beta) * p0, 0.5 * (1 - beta) * p0
    b = m.friction * a / (1 + 2 * beta).sqrt()
    u = ((p - pc) / a).clamp(-1e4, 1e4)
    w = (q / torch.maximum(b, 1e-8 * m.kappa)).clamp(max=1e6)

    star = torch.sign(u) * (1 - epsilon) * u.abs().clamp(max=1.0) ** (k + 1)
    gap, g = u - star, 1 - star**2
    t = (g / (star * gap + (gap**2 + w**2 * g).sqrt()).clamp(min=1e-30)).clamp(max=1.0)
    p_cross = pc + a * (star + t * gap)
    p_hat = torch.minimum(torch.maximum(p, -beta * p0), p0)
    p_new = torch.minimum(torch.maximum(p_cross, p_hat.clamp(max=0.0)), p_hat.clamp(min=0.0))
    w_new = torch.where(
        p_new == p_cross, t * w, ((p0 - p_new) * (p_new + beta * p0)).clamp(min=0).sqrt() / a
    )
    plastic = t < 1.0
    r = torch.where(plastic, (b * w_new / q.clamp(min=1e-300)).clamp(max=1.0), 1.0)
    p_new = torch.where(plastic, p_new, p)

    d_new = r[:, None] * d
    h = 0.5 * n2 * r**2
    delta = d_new.prod(1)
    root = 1 + 2 * (h / 3).sqrt()
    for _ in range(60):
        root = root - (root**3 - h * root + delta - 1) / (3 * root**2 - h)
    new_log_j = 0.5 * torch.log1p(-2 * p_new / m.kappa)
    b_axes = torch.exp(2.0 / 3.0 * new_log_j)[:, None] * (root[:, None] + d_new)
    step = log_j - 0.5 * torch.log1p(-2 * p_cross / m.kappa)
    step = (step + m.shear_damage * (1 - r) * q / (3 * m.mu)).clamp(-0.2, 0.2)
    return SvdReturn(
        (u_axes * b_axes[:, None, :]) @ u_axes.transpose(1, 2),
        torch.where(plastic, step, 0.0),
        plastic,
    )
