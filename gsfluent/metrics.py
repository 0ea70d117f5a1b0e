"""Image quality: PSNR and SSIM, for reports; the training loss is ``ops.photometric_loss``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.ops import ssim

__all__ = ["psnr", "ssim"]


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio [dB] of images with values in [0, 1].

    Args:
        image: What is judged, shape [H, W, C].
        target: What it should be, same shape.
        mask: Weight per pixel, shape [H, W]; all ones when None.

    Returns:
        ``-10 log10(mean squared error)``; infinity for equal images.

    Raises:
        ValueError: The shapes differ, or the mask is empty.
    """
    if image.dim() != 3 or image.shape != target.shape:
        raise ValueError(
            "psnr: image and target must have the same shape [H, W, C], "
            f"got {list(image.shape)} and {list(target.shape)}"
        )
    error = (image - target).square().mean(-1)
    if mask is None:
        mean = float(error.mean(dtype=torch.float64))
    else:
        if mask.shape != error.shape or not float(mask.sum()) > 0:
            raise ValueError(
                f"psnr: mask must have shape {list(error.shape)} and a positive sum, "
                f"got {list(mask.shape)} with sum {float(mask.sum())}"
            )
        mean = float((error * mask).sum(dtype=torch.float64) / mask.sum(dtype=torch.float64))
    return math.inf if mean == 0 else -10.0 * math.log10(mean)
