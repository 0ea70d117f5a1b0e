"""SSIM and the photometric loss in plain PyTorch: the definition the kernels are tested against."""

from __future__ import annotations

import torch
from torch import Tensor

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(
    image: Tensor, target: Tensor, *, padding: str = "valid", reduction: str = "mean"
) -> Tensor:
    """Wang et al. 2004, equation 13, by five depthwise convolutions; see ``gsfluent.ops``.

    Args:
        image: Shape [H, W, C], floating.
        target: Same shape.
        padding: "valid" or "same" (zeros around both images).
        reduction: "mean" or "none".

    Returns:
        The mean, or the map.
    """
    offset = torch.arange(_WINDOW, dtype=image.dtype, device=image.device) - _WINDOW // 2
    line = torch.exp(-offset.square() / (2.0 * _SIGMA**2))
    window = torch.outer(line, line) / line.sum() ** 2
    x, y = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    border = _WINDOW // 2 if padding == "same" else 0

    def blur(value: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(value, window[None, None], padding=border)

    mean_x, mean_y = blur(x), blur(y)
    variance_x = blur(x * x) - mean_x.square()
    variance_y = blur(y * y) - mean_y.square()
    covariance = blur(x * y) - mean_x * mean_y
    above = (2.0 * mean_x * mean_y + _C1) * (2.0 * covariance + _C2)
    below = (mean_x.square() + mean_y.square() + _C1) * (variance_x + variance_y + _C2)
    value = (above / below)[:, 0].permute(1, 2, 0)
    return value.mean() if reduction == "mean" else value


def photometric_loss(
    image: Tensor,
    target: Tensor,
    *,
    ssim_weight: float = 0.2,
    padding: str = "valid",
    valid: Tensor | None = None,
    alpha: Tensor | None = None,
    mask: Tensor | None = None,
    backdrop: Tensor | None = None,
    mask_weight: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The loss term by term; arguments and order of the result as in ``gsfluent.ops``.

    Args:
        image: Rendering, shape [H, W, C].
        target: Photograph, same shape.
        ssim_weight: Share of the similarity.
        padding: "valid" or "same".
        valid: Share of each pixel that is covered, shape [H, W].
        alpha: Opacity, shape [H, W].
        mask: What it should be, shape [H, W].
        backdrop: Colour behind the object, shape [C].
        mask_weight: Weight of the opacity's error.

    Returns:
        Loss, mean |miss|, mean similarity, mean miss^2, mean |excess|.
    """
    if valid is not None:
        image = image * valid[..., None]
        alpha = None if alpha is None else alpha * valid
    miss = image - target
    excess = torch.zeros_like(image[..., 0])
    if alpha is not None and mask is not None:
        excess = alpha - mask
        if backdrop is not None:
            miss = miss - excess[..., None] * backdrop
    l1, similarity = miss.abs().mean(), ssim(image, target, padding=padding)
    loss = (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - similarity)
    loss = loss + mask_weight * excess.abs().mean()
    return loss, l1, similarity, miss.square().mean(), excess.abs().mean()
