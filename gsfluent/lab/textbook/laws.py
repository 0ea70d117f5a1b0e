"""Laws of the textbook solver: state kept as F or as e = b - I, stresses, NACC return maps.

Formulas of equations.md: 2.1 (neo-Hookean), 9.1 (fixed corotated). The return maps are in
:mod:`gsfluent.lab.textbook.nacc`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Elastic(NamedTuple):
    """What the laws read of a state."""

    e: Tensor  # b - I, [N, 3, 3]
    j: Tensor  # volume ratio, with its sign where F is stored, [N]
    j2m1: Tensor  # J^2 - 1, [N]
    log_j: Tensor  # ln J, [N]


def trace(m: Tensor) -> Tensor:
    """Trace, [N]."""
    return m.diagonal(dim1=1, dim2=2).sum(1)


def det(m: Tensor) -> Tensor:
    """Determinant by the triple product, [N]."""
    return (m[:, 0] * torch.linalg.cross(m[:, 1], m[:, 2], dim=1)).sum(1)


def deviator(m: Tensor) -> Tensor:
    """Traceless part."""
    return m - (trace(m) / 3.0)[:, None, None] * _one(m)


def _one(m: Tensor) -> Tensor:
    return torch.eye(3, dtype=m.dtype, device=m.device)


def advance(state: Tensor, increment: Tensor, storage: str) -> Tensor:
    """Push F or e = b - I forward by I + A."""
    if storage == "F":
        return (_one(increment) + increment) @ state  # as codes write it
    h = increment + increment @ state
    return state + h + h.mT + h @ increment.mT


def measure(state: Tensor, storage: str) -> Elastic:
    """Strain and volume ratio of a state."""
    if storage == "F":
        j = det(state)
        return Elastic(state @ state.mT - _one(state), j, j * j - 1.0, j.log())
    first = trace(state)
    second = 0.5 * (first**2 - (state * state).sum((1, 2)))
    j2m1 = first + second + det(state)
    return Elastic(state, (1.0 + j2m1).sqrt(), j2m1, 0.5 * torch.log1p(j2m1))


def _svd(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """U, sigma, V^T with U and V rotations: the smallest value takes the sign of det F."""
    fine = torch.isfinite(f).all(2).all(1)
    u, sigma, vt = torch.linalg.svd(torch.where(fine[:, None, None], f, _one(f)))
    flip_u, flip_v = det(u) < 0, det(vt) < 0
    last = torch.tensor([1.0, 1.0, -1.0], dtype=f.dtype, device=f.device)
    u = torch.where(flip_u[:, None, None], u * last, u)
    vt = torch.where(flip_v[:, None, None], vt * last[:, None], vt)
    sigma = torch.where((flip_u ^ flip_v)[:, None], sigma * last, sigma)
    return u, torch.where(fine[:, None], sigma, torch.nan), vt


def clamped(state: Tensor, storage: str, low: float, high: float, inverted: Tensor) -> Tensor:
    """State with J in [low, high], by an even stretch; what is inverted gets ``low``."""
    m = measure(state, storage)
    turned = inverted | ~(m.j > 0)
    outside = turned | (m.j < low) | (m.j > high)
    rows = outside.nonzero()[:, 0]
    if rows.shape[0] == 0:
        return state
    state, j = state.clone(), m.j[rows]
    lost = turned[rows][:, None, None]
    stretch = (j.clamp(low, high) / torch.where(turned[rows], 1.0, j)) ** (1.0 / 3.0)
    if storage == "F":
        u, _, vt = _svd(state[rows])
        state[rows] = torch.where(
            lost, low ** (1.0 / 3.0) * (u @ vt), stretch[:, None, None] * state[rows]
        )
        return state
    one = _one(state)
    b = (state[rows] + one) * (stretch * stretch)[:, None, None]
    state[rows] = torch.where(lost, low ** (2.0 / 3.0) * one, b) - one
    return state


def with_stretch(f: Tensor, e: Tensor) -> Tensor:
    """F with the axes of ``f`` and the left Cauchy-Green tensor I + e of the same axes."""
    u, _, vt = _svd(f)
    b = (u.mT @ e @ u).diagonal(dim1=1, dim2=2) + 1.0
    return (u * b.sqrt()[:, None, :]) @ vt


def neo_hookean(m: Elastic, mu: Tensor, kappa: Tensor, *, energy_as_pressure: bool) -> Tensor:
    """Kirchhoff stress [Pa], [N, 3, 3]; with claymore's energy where its derivative belongs."""
    isochoric = (mu * m.j ** (-2.0 / 3.0))[:, None, None] * deviator(m.e)
    volumetric = m.j2m1
    if energy_as_pressure:
        volumetric = 0.5 * m.j2m1 - m.log_j
    return isochoric + (0.5 * kappa * volumetric)[:, None, None] * _one(m.e)


def corotated(state: Tensor, storage: str, mu: Tensor, kappa: Tensor) -> Tensor:
    """Kirchhoff stress of the fixed corotated law [Pa], [N, 3, 3]."""
    m = measure(state, storage)
    pressure = ((kappa - 2.0 / 3.0 * mu) * m.j * (m.j - 1.0))[:, None, None] * _one(state)
    if storage == "F":
        u, _, vt = _svd(state)
        return 2.0 * mu[:, None, None] * (state - u @ vt) @ state.mT + pressure
    values, axes = torch.linalg.eigh(torch.nan_to_num(state))
    root = values / (1.0 + (1.0 + values).clamp(min=0.0).sqrt())  # sqrt(1 + x) - 1
    stretch = (axes * root[:, None, :]) @ axes.mT
    return 2.0 * mu[:, None, None] * (state - stretch) + pressure
