"""Holes, stains and greyness of a photographed cut; arguments as in :mod:`.light`."""

from __future__ import annotations

import numpy as np

from gsfluent._lazy import cv2, ndimage
from gsfluent.colors import lab_to_rgb, rgb_to_lab
from gsfluent.pipeline.texture.volume.domain import smoothstep
from gsfluent.spatial.voxels import distance_transform

_GREY = 8.0  # Lab chroma below which a pixel counts as grey
_CAVITY = 0.65  # light at the bottom of a small cavity relative to its rim


def fill_holes(
    image: np.ndarray, mask: np.ndarray, depth: np.ndarray, ground: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, str | None]:
    """Give open cavities of the core, bool [H, W], the colour of their walls.

    Where a cut face has a hole (the carpels of an apple), the camera sees the ground (its Lab
    colour) through it, or nothing; as a material that would be soot. Dark pieces in the innermost
    third of the face, black or of the ground's colour, are painted with the colour of their rim,
    darker towards their middle as a cavity is. Seeds lie farther out or have a colour of their own,
    and stay.
    """
    area, largest = float(mask.sum()), float(depth.max())
    lab = rgb_to_lab(cv2.GaussianBlur(image, (0, 0), max(0.5, 0.003 * np.sqrt(area))))
    face = np.median(lab[mask], axis=0)
    # far below the flesh, near black, and not brown as seeds are
    dark = (lab[..., 0] < 16.0) & (lab[..., 0] < face[0] - 22.0) & (lab[..., 1] < 12.0)
    if ground is not None and np.linalg.norm(ground - face) > 25.0:
        dark |= np.linalg.norm(lab - ground, axis=2) < 10.0
    labels, count = ndimage.label(dark & mask)
    none = np.zeros(mask.shape, bool)
    if count == 0:
        return image, none, None
    number = np.arange(1, count + 1)
    pixels = ndimage.sum_labels(np.ones_like(labels), labels, number)
    inner = ndimage.mean(depth, labels, number) / max(largest, 1e-6)
    good = np.concatenate(
        [[False], (pixels > 2e-4 * area) & (pixels < 0.08 * area) & (inner > 0.66)]
    )
    # compact dark blobs all over the face are seeds
    boxes = [np.prod([s.stop - s.start for s in box]) for box in ndimage.find_objects(labels)]
    seeds = (pixels > 2e-4 * area) & (inner <= 0.66) & (inner > 0.1)
    if (seeds & (pixels > 0.6 * np.array(boxes))).sum() >= 4:
        return image, none, None
    hole = good[labels]
    share = float(hole.sum()) / area
    if share < 1e-3:
        return image, none, None
    # the blurred edge of a hole is neither hole nor flesh
    rim = max(1, round(0.004 * np.sqrt(area)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1,) * 2)
    wide = cv2.dilate(hole.astype(np.uint8), kernel)
    bytes_ = (image * 255).round().astype(np.uint8)
    # and next to it lies its shadow
    shadow = cv2.dilate(wide, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (6 * rim + 1,) * 2))
    wall = cv2.inpaint(bytes_, shadow, 3 * rim, cv2.INPAINT_TELEA).astype(np.float32) / 255.0
    wall = np.asarray(cv2.GaussianBlur(wall, (0, 0), 2.0 * rim))
    far = smoothstep(distance_transform(wide > 0) / (0.012 * np.sqrt(area)))[..., None]
    # light that went back and forth between the walls is dimmer and more of their colour
    cavity = wall ** (1.0 + far) * (1.0 - (1.0 - _CAVITY) * far)
    done = np.where(wide[..., None] > 0, cavity, image).astype(np.float32)
    return done, wide > 0, f"holes: {100 * share:.1f} % of the face is open; painted as cavities"


def grey_share(image: np.ndarray, mask: np.ndarray) -> float:
    """Share of the face whose colour is grey (Lab chroma below 8)."""
    lab = rgb_to_lab(image[mask])
    return float((np.hypot(lab[:, 1], lab[:, 2]) < _GREY).mean())


def remove_stain(
    image: np.ndarray, mask: np.ndarray, keep: np.ndarray | None = None
) -> tuple[np.ndarray, str | None]:
    """Take a grey stain out of a coloured material; pixels to ``keep`` (cavities) are not stained.

    For faces stained for a test (iodine turns starch blue-black) that show some unstained material:
    where the local mean colour has lost most of the chroma of the most coloured tenth, it is
    replaced by that of the unstained part, and the texture is scaled to the contrast it has there.
    Small coloured things (seeds, veins) are above the local mean's scale and stay.
    """
    if keep is not None:
        mask = mask & ~keep

    lab = rgb_to_lab(image).astype(np.float64)
    width = 0.015 * float(np.sqrt(mask.sum()))
    share = ndimage.gaussian_filter(mask.astype(float), width) + 1e-6

    def smooth(field: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(np.where(mask, field, 0.0), width) / share

    low = np.stack([smooth(lab[..., c]) for c in range(3)], -1)
    chroma = np.hypot(low[..., 1], low[..., 2])
    strong = float(np.quantile(chroma[mask], 0.9))
    weight = np.where(mask, smoothstep((0.92 * strong - chroma) / (0.35 * strong)), 0.0)
    clean = mask & (weight < 0.3)
    stained = float(weight[mask].mean())
    if strong < 20.0 or stained < 0.1 or clean.sum() < 0.02 * mask.sum():
        return image, None
    # the lighter half of what is clean: the rest is the core, half in shadow
    light = clean & (low[..., 0] >= np.median(low[clean][:, 0]))
    middle = np.median(lab[light], axis=0)
    rest = lab - low
    contrast = np.stack([np.sqrt(smooth(rest[..., c] ** 2)) for c in range(3)], -1)
    gain = np.minimum(1.0, np.median(contrast[light], axis=0) / np.maximum(contrast, 1e-3))
    # a tenth of the old unevenness remains: flesh is not one colour
    drift = 0.1 * (low - np.median(low[mask], axis=0)) * np.array([1.0, 0.3, 0.3])
    target = middle + drift + rest * gain
    mixed = lab + weight[..., None] * (target - lab)
    done = lab_to_rgb(mixed).astype(np.float32)
    return (
        np.where(mask[..., None], done, image),
        f"stain: {100 * stained:.0f} % of the face given the colour of its unstained part",
    )


def recolor(
    image: np.ndarray, mask: np.ndarray, depth: np.ndarray, palette: np.ndarray
) -> np.ndarray:
    """Colours of a palette on the lightness pattern of a photograph.

    In every depth range the lightness is moved to the palette's mean and contrast there; hue and
    chroma are the palette's: [B, n, 3] in 0..1, n samples of the material in each of B equal ranges
    from the outline to the deepest point.
    """
    bins = len(palette)
    lab = rgb_to_lab(image).astype(np.float64)
    light = lab[..., 0][mask]
    relative = depth[mask] / max(float(depth.max()), 1e-6)
    which = np.clip((relative * bins).astype(int), 0, bins - 1)
    count = np.maximum(np.bincount(which, minlength=bins), 1)
    mean = np.bincount(which, light, bins) / count
    spread = np.sqrt(np.bincount(which, (light - mean[which]) ** 2, bins) / count)
    colors = rgb_to_lab(palette).astype(np.float64)
    center = (np.arange(bins) + 0.5) / bins

    def at(values: np.ndarray) -> np.ndarray:
        return np.interp(relative, center, values)

    deviation = (light - at(mean)) / np.maximum(at(spread), 1.0)
    out = np.stack([at(colors[..., c].mean(1)) for c in range(3)], 1)
    out[:, 0] += deviation * at(colors[..., 0].std(1))
    done = image.copy()
    done[mask] = lab_to_rgb(out.astype(np.float32))
    return done
