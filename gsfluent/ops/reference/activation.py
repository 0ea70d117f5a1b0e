"""Activations and rules of shape in plain PyTorch: what the kernels are tested against."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsfluent.geometry import quaternion_to_matrix

SEEN = 0.02
"""Opacity at which a Gaussian ends for the eye."""


def activate(
    scales: Tensor, opacities: Tensor, sh0: Tensor, sh_rest: Tensor, degree: int
) -> tuple[Tensor, Tensor, Tensor]:
    """See :func:`gsfluent.ops.activate`; differentiable."""
    sh = torch.cat([sh0, sh_rest[:, : (degree + 1) ** 2 - 1]], 1)
    return scales.exp().expand(-1, 3), torch.sigmoid(opacities), sh


def penalty(
    scales: Tensor,
    opacities: Tensor,
    *,
    size: float,
    needle: float,
    aspect: float,
    opacity: float,
) -> Tensor:
    """The penalties of :func:`gsfluent.ops.activate_backward`, a scalar; differentiable."""
    longest, middle, _ = scales.sort(dim=1, descending=True).values.unbind(1)
    ratio = longest / middle.clamp_min(1e-9)
    excess = (ratio - aspect).clamp_min(0.0).sum()
    return size * scales.sum() + needle * excess + opacity * opacities.sum()


def shorten_axes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    beyond: Callable[[Tensor], Tensor],
    overhang: float,
) -> Tensor:
    """See :func:`gsfluent.ops.shorten_axes`; ``beyond`` says how far points [M, 3] lie outside."""
    reach = (2.0 * (opacities.clamp_min(SEEN) / SEEN).log()).sqrt()
    arms = (quaternion_to_matrix(quats) * (scales * reach[:, None])[:, None, :]).mT

    def fits(share: Tensor, most: float = overhang) -> Tensor:
        arm = arms * share[..., None]
        tips = torch.stack([means[:, None] + arm, means[:, None] - arm], 2)
        return (beyond(tips.reshape(-1, 3)).reshape(tips.shape[:3]) <= most).all(2)

    low, high = torch.zeros_like(scales), torch.ones_like(scales)
    for _ in range(8):
        middle = 0.5 * (low + high)
        good = fits(middle)
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    whole = fits(torch.ones_like(scales), overhang * (1.0 + 1e-3))
    return torch.where(whole, torch.ones_like(low), low.clamp_min(0.02))
