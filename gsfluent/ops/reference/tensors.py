"""Symmetric 3x3 tensors of the constitutive reference: algebra, and functions of a tensor.

Strains are [N, 6] (xx, yy, zz, xy, xz, yz).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def to_matrix(sym: Tensor) -> Tensor:
    """[N, 6] (xx, yy, zz, xy, xz, yz) to [N, 3, 3]."""
    return sym[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)


def to_sym(matrix: Tensor) -> Tensor:
    """[N, 3, 3] symmetric to [N, 6]."""
    return matrix.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]


def diagonal(value: Tensor) -> Tensor:
    """Value times I, [N] to [N, 6]."""
    zero = torch.zeros_like(value)
    return torch.stack([value, value, value, zero, zero, zero], dim=1)


def det_minus_one(matrix: Tensor) -> Tensor:
    """det(I + m) - 1 by its invariants."""
    trace = matrix.diagonal(dim1=1, dim2=2).sum(1)
    second = 0.5 * (trace**2 - (matrix @ matrix).diagonal(dim1=1, dim2=2).sum(1))
    return trace + second + _det(matrix)


def _det(m: Tensor) -> Tensor:
    return (m[:, 0] * torch.linalg.cross(m[:, 1], m[:, 2], dim=1)).sum(1)


def safe_norm(sym: Tensor) -> Tensor:
    """Frobenius norm with a zero gradient at zero, [N]."""
    square = (sym[:, :3] ** 2).sum(1) + 2.0 * (sym[:, 3:] ** 2).sum(1)
    tiny = square < 1e-60 if sym.dtype == torch.float64 else square < 1e-37
    return torch.where(tiny, 0.0, torch.where(tiny, 1.0, square).sqrt())


def unit_det_shift(d: Tensor) -> Tensor:
    """Largest root m of det(m I + d) = 1, minus one; d traceless, [N, 6]."""
    norm2 = (d[:, :3] ** 2).sum(1) + 2.0 * (d[:, 3:] ** 2).sum(1)
    h, c = 0.5 * norm2, 0.5 * norm2 - _det(to_matrix(d))

    def residual(y: Tensor, h: Tensor, c: Tensor) -> Tensor:
        return ((y + 3.0) * y + (3.0 - h)) * y - c

    def slope(y: Tensor, h: Tensor) -> Tensor:
        return (3.0 * y + 6.0) * y + (3.0 - h)

    with torch.no_grad():
        y = 2.0 * (h / 3.0).sqrt()
        for turn in range(60):  # monotone from above
            rise = slope(y, h)
            step = torch.where(rise > 0, residual(y, h, c) / rise, 0.0)
            y = y - step
            if y.is_cuda and turn % 4 != 3:  # asking costs more there than a step too many
                continue
            if not bool((step.abs() > 1e-15 * (1.0 + y.abs())).any()):
                break
        safe_slope = torch.where(slope(y, h) > 0, slope(y, h), 1.0)
    return y - residual(y, h, c) / safe_slope


def strain_from_isochoric(d: Tensor, log_j: Tensor) -> Tensor:
    """Strain b - I of the state with isochoric deviator d and volume ratio exp(log_j)."""
    y = unit_det_shift(d)
    s = torch.expm1(2.0 / 3.0 * log_j)
    return (1.0 + s)[:, None] * d + diagonal(y + s * (1.0 + y))


def deviator(sym: Tensor) -> Tensor:
    """Traceless part, [N, 6]."""
    return sym - diagonal(sym[:, :3].mean(1))


EIGEN_BATCH = 8192
"""Matrices that cuSOLVER is given at a time: of 85,000 it made an internal error on an H200."""


def _eigh(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues and vectors of symmetric matrices, [N, 3] and [N, 3, 3]."""
    if not matrix.is_cuda or matrix.shape[0] <= EIGEN_BATCH:
        return tuple(torch.linalg.eigh(matrix))
    values, vectors = zip(*map(torch.linalg.eigh, matrix.split(EIGEN_BATCH)), strict=True)
    return torch.cat(values), torch.cat(vectors)


class _Spectral(torch.autograd.Function):
    """f(m) of symmetric matrices, with the derivative of Daletskii and Krein.

    The derivative is made of divided differences that are exact for equal eigenvalues, where
    automatic differentiation of the eigenvectors would divide by zero.
    """

    @staticmethod
    def forward(matrix: Tensor, kind: str) -> tuple[Tensor, Tensor, Tensor]:
        x, vectors = _eigh(matrix)
        if kind == "log":  # ln(I + m) / 2
            y = 0.5 * torch.log1p(x.clamp(min=-1.0 + 1e-6))
        elif kind == "sqrt":  # sqrt(I + m) - I
            y = x / (1.0 + (1.0 + x).clamp(min=0.0).sqrt())
        elif kind == "tension":  # max(ln(I + m) / 2, 0)
            y = 0.5 * torch.log1p(x.clamp(min=0.0))
        else:  # exp(m) - I
            y = torch.expm1(x)
        return (vectors * y[:, None, :]) @ vectors.mT, x, vectors

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.kind = inputs[1]
        ctx.save_for_backward(output[1], output[2])
        ctx.mark_non_differentiable(output[1], output[2])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        x, vectors = ctx.saved_tensors
        i, j = x[:, :, None], x[:, None, :]
        if ctx.kind == "log":
            low, high = torch.minimum(i, j), torch.maximum(i, j)
            base = (1.0 + low).clamp(min=1e-6)
            z = (high - low) / base
            slope = 0.5 * torch.where(z > 0, torch.log1p(z) / torch.where(z > 0, z, 1.0), 1.0)
            slope = slope / base
        elif ctx.kind == "tension":
            low, high = torch.minimum(i, j), torch.maximum(i, j)
            z, apart = (high - low) / (1.0 + low).clamp(min=1e-6), high - low
            both = torch.log1p(z) / torch.where(z > 0, z, 1.0) / (1.0 + low).clamp(min=1e-6)
            both = 0.5 * torch.where(z > 0, both, 1.0 / (1.0 + low).clamp(min=1e-6))
            one = 0.5 * torch.log1p(high.clamp(min=0.0)) / torch.where(apart > 0, apart, 1.0)
            slope = torch.where(low >= 0, both, torch.where(high > 0, one, 0.0))
        elif ctx.kind == "sqrt":
            slope = 1.0 / ((1.0 + i).clamp(min=1e-12).sqrt() + (1.0 + j).clamp(min=1e-12).sqrt())
        else:
            z = i - j
            ratio = torch.where(z != 0, torch.expm1(z) / torch.where(z != 0, z, 1.0), 1.0)
            slope = torch.exp(j) * ratio
        inner = vectors.mT @ (0.5 * (grads[0] + grads[0].mT)) @ vectors
        return vectors @ (slope * inner) @ vectors.mT, None


def spectral(sym: Tensor, kind: str) -> Tensor:
    """f(e) of strains e, [N, 6].

    ``log``: ln(I + e) / 2; ``tension``: its positive part; ``sqrt``: sqrt(I + e) - I; ``exp``:
    exp(e) - I.
    """
    return to_sym(_Spectral.apply(to_matrix(sym), kind)[0])
