"""``polar_clamped`` in plain PyTorch: the definition the kernels are tested against."""

from __future__ import annotations

import torch
from torch import Tensor


def polar_clamped(deformation: Tensor, lo: float = 0.3, hi: float = 2.0) -> tuple[Tensor, Tensor]:
    """Rotation and stretch-clamped deformation by LAPACK's SVD; see ``gsfluent.ops``.

    Args:
        deformation: Deformation gradients, shape [N, 3, 3], finite.
        lo: Smallest stretch kept [-].
        hi: Largest stretch kept [-].

    Returns:
        ``(R, F_clamped)``, both [N, 3, 3].
    """
    u, s, vh = torch.linalg.svd(deformation)
    # LAPACK's factors may be reflections; move both signs onto the smallest singular value.
    sign = torch.linalg.det(u) * torch.linalg.det(vh)
    u = torch.cat([u[..., :2], u[..., 2:] * torch.linalg.det(u)[:, None, None]], dim=-1)
    vh = torch.cat([vh[..., :2, :], vh[..., 2:, :] * torch.linalg.det(vh)[:, None, None]], dim=-2)
    s = torch.cat([s[:, :2], s[:, 2:] * sign[:, None]], dim=-1)
    return u @ vh, (u * s.clamp(lo, hi)[:, None, :]) @ vh
