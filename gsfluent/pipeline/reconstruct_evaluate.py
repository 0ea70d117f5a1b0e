"""Held-out quality of a reconstruction."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent.data import BACKGROUND, Camera, Capture, Gaussians
from gsfluent.data.capture import View
from gsfluent.metrics import psnr, ssim
from gsfluent.pipeline.draw import draw
from gsfluent.pipeline.reconstruct_masks import silhouette

HOLD_OUT = 8
"""Every eighth photograph judges, the others teach."""


@torch.no_grad()
def render_view(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Render Gaussians as a camera sees them, before black: image [H, W, 3] and alpha [H, W]."""
    result = draw(gaussians, camera)
    return result.image, result.alpha


class Judged(NamedTuple):
    """A held-out photograph and the render that is compared with it.

    Attributes:
        image: The render, [H, W, 3] in [0, 1], on the CPU; before white when there is a mask.
        target: The photograph, likewise.
        valid: 1 where the photograph covers the pixel, [H, W]; None when everywhere.
    """

    image: Tensor
    target: Tensor
    valid: Tensor | None


def judged(gaussians: Gaussians, view: View) -> Judged:
    """Render what a photograph shows, as :func:`evaluate` compares it."""
    image, alpha = (value.cpu() for value in render_view(gaussians, view.camera))
    target = view.image
    if view.mask is not None:
        mask = view.mask[..., None]
        target = target * mask + (1.0 - mask)
        image = image + (1.0 - alpha[..., None])
    valid = None if view.valid is None else view.valid.float()
    return Judged(image.clamp(0.0, 1.0), target, valid)


def evaluate(gaussians: Gaussians, held_out: Capture | None, max_size: int) -> dict[str, Any]:
    """PSNR and SSIM on photographs that were not trained on.

    With masks the whole image is compared before white (object times mask plus white), and
    ``psnr_inside`` looks only at pixels inside the mask. Without masks the whole photograph is
    compared, and ``psnr_inside`` looks at the silhouette of the splats not labelled ``BACKGROUND``
    (when some are): the object as found, since nobody said where it is.

    Args:
        gaussians: What to judge.
        held_out: Photographs to judge by, or None.
        max_size: Longer side of the images [px].

    Returns:
        ``psnr``, ``ssim`` (means over the images, None without any), ``psnr_inside`` (None when
        nothing tells the object), ``psnr_region`` ("whole image before white" or "whole image"),
        ``psnr_views``.
    """
    if held_out is None:
        return {"psnr": None, "ssim": None, "psnr_inside": None, "psnr_region": "none held out"}
    whole, inside, similar, masked = [], [], [], False
    found = rest = None
    if gaussians.labels is not None and bool((gaussians.labels == BACKGROUND).any()):
        found = gaussians.select(gaussians.labels != BACKGROUND)
        rest = gaussians.select(gaussians.labels == BACKGROUND)
    for index in range(len(held_out)):
        view = held_out.view(index, max_size)
        image, target, valid = judged(gaussians, view)
        masked |= view.mask is not None
        whole.append(psnr(image, target, valid))
        shut = 1.0 if valid is None else valid[..., None]
        similar.append(float(ssim(image * shut, target * shut)))
        shown = view.mask
        if shown is None and found is not None and rest is not None:
            camera = view.camera
            shown = silhouette(
                found, rest, camera.viewmat, camera.K, camera.width, camera.height
            ).cpu()
        if shown is not None:
            region = (shown > 0.5).float() * (1.0 if valid is None else valid)
            if float(region.sum()) > 0:
                inside.append(psnr(image, target, region))
    return {
        "psnr": round(sum(whole) / len(whole), 3),
        "ssim": round(sum(similar) / len(similar), 4),
        "psnr_inside": round(sum(inside) / len(inside), 3) if inside else None,
        "psnr_region": "whole image before white" if masked else "whole image",
        "psnr_views": [round(value, 2) for value in whole],
    }
