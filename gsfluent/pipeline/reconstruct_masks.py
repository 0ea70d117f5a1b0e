"""Masks for a capture that has none: silhouettes of the object found in a first reconstruction."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.pipeline.draw import draw_at

_REACH = 0.018  # of the longer side: how far the border of a silhouette may be wrong
_ROUNDS = 3
_SMALLEST_BODY = 40  # pixels


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
    seen = draw_at(both, viewmat, K, (width, height), colors=flag[:, None].contiguous())
    return seen.image[..., 0]


def refined_mask(share: Tensor, image: Tensor, *, inner: float = 1.0) -> Tensor | None:
    """Mask of the object from a rough silhouette and the photograph.

    Args:
        share: Rough share of the object per pixel, [H, W].
        image: The photograph, [H, W, 3] in [0, 1].
        inner: How much more the silhouette may be too large than too small.

    Returns:
        One closed body with soft edges, [H, W], or None when the silhouette is all but empty.
    """
    import cv2
    from scipy import ndimage

    values = share.numpy()
    reach = max(3, round(_REACH * max(values.shape)))
    body = ndimage.binary_fill_holes(ndimage.binary_opening(values > 0.5))
    if int(body.sum()) < _SMALLEST_BODY:
        return None
    trimap = np.where(body, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[ndimage.binary_erosion(body, iterations=round(inner * reach))] = cv2.GC_FGD
    trimap[~ndimage.binary_dilation(values > 0.3, iterations=reach)] = cv2.GC_BGD
    known = np.isin(trimap, (cv2.GC_BGD, cv2.GC_PR_BGD))
    if bool(known.any()) and not bool(known.all()):
        pixels = np.ascontiguousarray((image.numpy()[..., ::-1] * 255).astype(np.uint8))
        cv2.setRNGSeed(0)
        behind, before = np.zeros((1, 65)), np.zeros((1, 65))
        box = (0, 0, 1, 1)  # not read in this mode
        cv2.grabCut(pixels, trimap, box, behind, before, _ROUNDS, cv2.GC_INIT_WITH_MASK)
        body = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    pieces, count = ndimage.label(ndimage.binary_opening(body))
    if count == 0:
        return None
    sizes = np.bincount(pieces.reshape(-1))
    sizes[0] = 0
    if int(sizes.max()) < _SMALLEST_BODY:
        return None
    body = ndimage.binary_fill_holes(pieces == int(sizes.argmax()))
    soft = cv2.GaussianBlur(body.astype(np.float32), (3, 3), 0.6)
    return torch.from_numpy(soft)
