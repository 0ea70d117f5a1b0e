"""Masks for a capture that has none: silhouettes of the object found in a first reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Gaussians
from gsfluent.pipeline.reconstruct_views import TrainView, cropped


@torch.no_grad()
def silhouette(
    found: Gaussians, rest: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int
) -> Tensor:
    """Share of each pixel that shows the object, behind whatever of the rest stands before it.

    Args:
        found: The object.
        rest: Everything else.
        viewmat: World to camera [4, 4].
        K: Intrinsics [3, 3].
        width: Image width [px].
        height: Image height [px].

    Returns:
        Values in [0, 1], shape [H, W].
    """
    both = Gaussians.cat([found, rest])
    flag = torch.cat([torch.ones_like(found.opacities), torch.zeros_like(rest.opacities)])
    result = ops.rasterize(
        both.means,
        both.opacities,
        viewmat.to(both.means),
        K.to(both.means),
        width,
        height,
        quats=both.quats,
        scales=both.scales,
        colors=flag[:, None].contiguous(),
        near=1e-4,
    )
    return result.image[..., 0]


def masked_views(views: list[TrainView], found: Gaussians, rest: Gaussians) -> list[TrainView]:
    """The photographs cut to the silhouette of the object; those that do not show it are left out.

    The silhouette is made binary at one half, opened by one pixel, reduced to its largest body, its
    holes closed, then softened over one pixel.
    """
    result = []
    for view in views:
        width, height = view.size
        share = silhouette(found, rest, view.viewmat, view.K, width, height)
        mask = _clean(share)
        if mask is None:
            continue
        result.append(cropped(replace(view, mask=mask.to(view.color))))
    return result


def _clean(share: Tensor) -> Tensor | None:
    """A single closed silhouette with soft edges [H, W], or None when nothing is left."""
    from scipy import ndimage

    values = share.cpu().numpy()
    body = ndimage.binary_opening(values > 0.5, iterations=1)
    pieces, count = ndimage.label(body)
    if count == 0:
        return None
    sizes = np.bincount(pieces.reshape(-1))
    sizes[0] = 0
    body = ndimage.binary_fill_holes(pieces == int(sizes.argmax()))
    if int(body.sum()) < 30:
        return None
    soft = np.where(body, np.maximum(values, 0.5), 0.0)
    edge = ndimage.binary_dilation(body) & ~body
    soft[edge] = values[edge] * 0.5
    inner = ndimage.binary_erosion(body)
    soft[inner] = 1.0
    return torch.from_numpy(soft.astype(np.float32))
