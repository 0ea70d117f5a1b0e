"""Carrying splats by a deformation gradient: rotation and stretch-limited deformation."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent._check import check_tensor


def polar_clamped(deformation: Tensor, lo: float = 0.3, hi: float = 2.0) -> tuple[Tensor, Tensor]:
    """Rotation and stretch-clamped copy of deformation gradients.

    With ``F = U diag(s) V^T`` (U, V rotations; the smallest s carries the sign of det F) the
    results are ``R = U V^T`` and ``U diag(clamp(s, lo, hi)) V^T``. To carry a Gaussian: covariance
    ``F' S F'^T`` with the clamped F', colour (SH) and normals rotated by R.

    Args:
        deformation: Deformation gradients F, shape [N, 3, 3], float32 or float64.
        lo: Smallest stretch kept [-], > 0. A reflected F (det < 0) has its smallest stretch raised
            to ``lo``, i.e. it is un-inverted.
        hi: Largest stretch kept [-], >= lo.

    Returns:
        ``(R, F_clamped)``, both [N, 3, 3]. R is a rotation (det +1) for every input; a matrix with
        a non-finite entry yields the identity in both.

    Raises:
        TypeError: ``deformation`` is not a float32 or float64 tensor.
        ValueError: Wrong shape, or not ``0 < lo <= hi``.

    Gradient: none. One-sided Jacobi, 6 fixed sweeps (Hestenes 1958); see csrc/core/svd3.h.
    """
    check_tensor("polar_clamped", "deformation", deformation, shape=("N", 3, 3))
    if not (0.0 < lo <= hi and math.isfinite(hi)):
        raise ValueError(f"polar_clamped: bounds must satisfy 0 < lo <= hi, got lo={lo}, hi={hi}")
    rotation, clamped = torch.ops.gsfluent.polar_clamped.default(deformation, float(lo), float(hi))
    return rotation, clamped


@torch.library.register_fake("gsfluent::polar_clamped")
def _polar_clamped_fake(deformation: Tensor, lo: float, hi: float) -> tuple[Tensor, Tensor]:
    shape = (deformation.shape[0], 3, 3)
    return deformation.new_empty(shape), deformation.new_empty(shape)


def _polar_no_gradient(ctx: torch.autograd.function.FunctionCtx, *grads: Tensor) -> None:
    raise NotImplementedError("polar_clamped: no gradient with respect to deformation")


torch.library.register_autograd("gsfluent::polar_clamped", _polar_no_gradient)
