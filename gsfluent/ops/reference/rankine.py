"""Rankine's surface for brittle matter in plain PyTorch: csrc/core/material/rankine.h.

Differentiable: the rounds that find the state are followed by the tape.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.reference.nacc import ALPHA_MAX, Material
from gsfluent.ops.reference.tensors import to_matrix, to_sym, unit_det_shift

STEEPEST = 0.98
ROUNDS = 40
TINY = 1e-30
SLACK = {torch.float64: 1e-12, torch.float32: 4e-6}


def strength(m: Material, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Strength f and -df/dalpha [Pa], [N]."""
    size = m.cohesion * m.kappa
    x = (m.hardening * (-alpha).clamp(min=0.0)).clamp(max=5.0)
    whole = alpha < 0.0
    return torch.where(whole, size * torch.sinh(x), 0.0), torch.where(
        whole, size * m.hardening * torch.cosh(x), 0.0
    )


def _cut_off(t: Tensor, lam: Tensor, mu: Tensor, f0: Tensor, slope: Tensor) -> Tensor:
    """What each principal direction opens, [N, 3], of trial stresses ``t``, largest first."""
    zero = torch.zeros_like(f0)
    one = (t[:, 0] - f0) / (lam + 2.0 * mu - slope)
    face = torch.stack([one, zero, zero], dim=1)
    two = (t[:, 0] + t[:, 1] - 2.0 * f0) / (2.0 * (lam + mu - slope))
    apart = torch.minimum((t[:, 0] - t[:, 1]) / (2.0 * mu), two)
    edge = torch.stack([0.5 * (two + apart), 0.5 * (two - apart), zero], dim=1)
    mean = t.mean(dim=1)
    three = (mean - f0) / (lam + 2.0 / 3.0 * mu - slope)
    corner = three[:, None] / 3.0 + (t - mean[:, None]) / (2.0 * mu[:, None])
    on_face = t[:, 1] - lam * one <= f0 - slope * one
    on_edge = t[:, 2] - lam * two <= f0 - slope * two
    found = torch.where(on_face[:, None], face, torch.where(on_edge[:, None], edge, corner))
    return torch.where((t[:, 0] > f0)[:, None], found, 0.0)


def _principal(mu: Tensor, kappa: Tensor, log_v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Principal stresses, isochoric strains less their mean, J^2 - 1."""
    log_j = log_v.sum(dim=1)
    iso = torch.expm1(2.0 * (log_v - log_j[:, None] / 3.0))
    iso = iso - iso.mean(dim=1, keepdim=True)
    j2m1 = torch.expm1(2.0 * log_j)
    return mu[:, None] * iso + 0.5 * (kappa * j2m1)[:, None], iso, j2m1


def _slide(d: Tensor, j2m1: Tensor, alpha: Tensor, m: Material) -> tuple[Tensor, Tensor]:
    slack = SLACK[d.dtype]
    size = (d[:, :3] ** 2).sum(1) + 2.0 * (d[:, 3:] ** 2).sum(1)
    q = (1.5 * size.clamp(min=1e-60)).sqrt() * m.mu
    most = torch.maximum(
        -m.shear_damage * strength(m, alpha)[0], -0.5 * m.friction * m.kappa * j2m1
    )
    most = most.clamp(min=0.0)
    slides = q > most * (1.0 + slack)
    share = torch.where(slides, most, 1.0) / torch.where(slides, q, 1.0)
    return share[:, None] * d, slides


def _open(
    d: Tensor, j2m1: Tensor, alpha: Tensor, m: Material, softens: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    slack = SLACK[d.dtype]
    matrix = to_matrix(d)
    none_left = (matrix.abs().amax(dim=(1, 2)) < TINY)[:, None]
    # directions of nothing have no gradient: any others will do
    apart = torch.diag(torch.tensor([-1.0, 0.0, 1.0], dtype=d.dtype, device=d.device))
    values, vectors = torch.linalg.eigh(torch.where(none_left[:, None], apart, matrix))
    y, vectors = torch.where(none_left, 0.0, values.flip(1)), vectors.flip(2)
    mean = 0.5 * m.kappa * j2m1
    f0, _ = strength(m, alpha)
    top = m.mu * y[:, 0]
    opens = top + mean > f0 + slack * (f0 + top.abs() + mean.abs())
    trial = 0.5 * torch.log1p((unit_det_shift(d)[:, None] + y).clamp(min=1e-6 - 1.0))
    trial = trial + (torch.log1p(j2m1) / 6.0)[:, None]
    lam = m.kappa - 2.0 / 3.0 * m.mu
    opened, log_v = torch.zeros_like(alpha), trial
    stress, iso, after = _principal(m.mu, m.kappa, log_v)
    none = torch.zeros_like(f0)
    for _ in range(ROUNDS):
        f, slope = strength(m, alpha + opened) if softens else (f0, none)
        slope = torch.minimum(slope, STEEPEST * m.kappa)
        off = trial - log_v
        t = stress + 2.0 * m.mu[:, None] * off + (lam * off.sum(dim=1))[:, None]
        by = _cut_off(t, lam, m.mu, f + slope * opened, slope)
        if softens:
            gone = alpha + by.sum(dim=1) >= 0.0
            free = _cut_off(t, lam, m.mu, none, none)
            held = _cut_off(t, lam, m.mu, f, none)
            free = torch.where((alpha + free.sum(dim=1) < 0.0)[:, None], held, free)
            by = torch.where(gone[:, None], free, by)
        opened, log_v = by.sum(dim=1), trial - by
        stress, iso, after = _principal(m.mu, m.kappa, log_v)
    turned = to_sym(vectors @ torch.diag_embed(iso) @ vectors.transpose(1, 2))
    d = torch.where(opens[:, None], turned, d)
    if softens:
        grown = alpha + opened
        pressed = after < -slack * (trial[:, 0].abs() + trial[:, 2].abs())
        kept = torch.maximum(alpha, grown.clamp(max=0.0))
        grown = torch.where(pressed, kept, grown.clamp(max=ALPHA_MAX))
        alpha = torch.where(opens, grown, alpha)
    return d, torch.where(opens, after, j2m1), alpha, opens


def rankine(
    d: Tensor, j2m1: Tensor, alpha: Tensor, m: Material, softens: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return ``(d, j2m1, alpha, plastic)`` of trial states.

    Args:
        d: Isochoric deviator, [N, 6].
        j2m1: J^2 - 1, [N].
        alpha: State, [N].
        m: Rows, of which ``shear_damage`` is -c.
        softens: Whether alpha moves with the state.
    """
    closes = (alpha > 0.0) & (j2m1 < 0.0)
    log_j = 0.5 * torch.log1p(j2m1)
    closing = torch.minimum(-log_j, alpha)
    left = torch.expm1(2.0 * (log_j + closing)) if softens else torch.zeros_like(j2m1)
    j2m1 = torch.where(closes, torch.where(closing < -log_j, left, 0.0), j2m1)
    if softens:
        alpha = torch.where(closes, alpha - closing, alpha)
    d, slid = _slide(d, j2m1, alpha, m)
    d, j2m1, alpha, opened = _open(d, j2m1, alpha, m, softens)
    d = torch.where(opened[:, None], _slide(d, j2m1, alpha, m)[0], d)
    return d, j2m1, alpha, closes | slid | opened
