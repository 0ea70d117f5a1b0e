"""Named baselines for comparison: what is left when nothing is known about the inside."""

from __future__ import annotations

import numpy as np

from gsfluent._lazy import cv2
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture


def color_copy(domain: InteriorDomain) -> InteriorTexture:
    """Colour of the nearest surface, as PhysGaussian gives its filled particles."""
    labels = np.zeros(domain.inside.shape, np.int32)
    return InteriorTexture(domain.skin.copy(), labels, {})


def telea_slices(domain: InteriorDomain, axes: tuple[int, ...] = (0, 1, 2)) -> InteriorTexture:
    """``cv2.inpaint`` (Telea 2004) slice by slice, averaged over the axes."""
    total = np.zeros((*domain.inside.shape, 3), np.float32)
    slices = 0
    for axis in axes:
        skin = np.moveaxis(domain.skin, axis, 0)
        inside = np.moveaxis(domain.inside, axis, 0)
        shell = np.moveaxis(domain.shell, axis, 0)
        out = np.moveaxis(total, axis, 0)
        for k in range(inside.shape[0]):
            hole = inside[k] & ~shell[k]
            image = (skin[k] * 255).round().astype(np.uint8)
            if hole.any():
                image = cv2.inpaint(image, hole.astype(np.uint8), 3, cv2.INPAINT_TELEA)
                slices += 1
            out[k] += image.astype(np.float32) / (255.0 * len(axes))
    labels = np.zeros(domain.inside.shape, np.int32)
    return InteriorTexture(total, labels, {"slices": slices})
