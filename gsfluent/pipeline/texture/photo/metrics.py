"""How like the exemplar (or the truth) an interior looks: statistics that need no downloads.

Pixel-wise measures are useless here: a blurred depth profile beats a second, equally true fruit in
PSNR. What is compared instead are distributions: of patches, of colours, of colours per depth, of
gradients. Colours are CIE Lab, in which a difference of 2 is about the smallest that is seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsfluent._lazy import ndimage
from gsfluent.colors import rgb_to_lab
from gsfluent.pipeline.texture.photo.exemplar import Exemplar
from gsfluent.pipeline.texture.volume.domain import InteriorDomain

Slice = tuple[np.ndarray, np.ndarray]
"""An image [H, W, 3] in 0..1 and its mask [H, W]."""

PATCHES = 8000
"""Patches compared unless asked for more; the draw itself then costs about 0.2."""
_QUANTILES = 512


def lab_histogram_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Mean absolute difference of the Lab quantile functions of colours [n, 3] and [m, 3]."""
    steps = np.linspace(0.01, 0.99, 99)
    first = np.quantile(rgb_to_lab(a.reshape(-1, 3)), steps, axis=0)
    second = np.quantile(rgb_to_lab(b.reshape(-1, 3)), steps, axis=0)
    return float(np.abs(first - second).mean())


def patch_distance(
    first: Sequence[Slice],
    second: Sequence[Slice],
    *,
    patch: int = 7,
    samples: int = PATCHES,
    seed: int = 0,
) -> float:
    """Sliced Wasserstein-1 distance between the Lab patches of two sets of slices (pSWD).

    Args:
        first: Slices with masks; only patches wholly inside the mask count.
        second: The same for the other set.
        patch: Edge of the patches [pixels].
        samples: Most patches drawn per set.
        seed: Seed of directions and draws; equal masks give equal draws.

    Returns:
        Distance in Lab units; NaN when a set holds no whole patch.
    """
    sets = [draw_patches(s, patch, samples, seed) for s in (first, second)]
    if not all(len(s) for s in sets):
        return float("nan")
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((sets[0].shape[1], 128)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=0)
    one, two = (_quantiles(s @ direction) for s in sets)
    return float(np.abs(one - two).mean())


def _quantiles(values: np.ndarray) -> np.ndarray:
    """Quantile functions of the columns of [n, p], float64 [512, p]."""
    ordered = np.sort(values, axis=0)
    place = (np.arange(_QUANTILES) + 0.5) / _QUANTILES * (len(ordered) - 1)
    low = np.floor(place).astype(int)
    high = np.minimum(low + 1, len(ordered) - 1)
    share = (place - low)[:, None]
    return ordered[low] * (1 - share) + ordered[high] * share


def patch_neighbours(
    first: Sequence[Slice], second: Sequence[Slice], *, seed: int = 0
) -> tuple[float, float]:
    """How far the patches of two sets are from their likeness in the other.

    Bidirectional similarity (Simakov et al. 2008).

    Args:
        first: The slices judged.
        second: The slices they should be like.
        seed: Seed of the draws of 4000 patches of 7 x 7 pixels per set.

    Returns:
        Coherence, the mean distance of the first set's patches from the nearest of the second
        (large where something was invented), and coverage, the other way round (large where
        something is missing); Lab units per value, NaN when a set holds no whole patch.
    """
    a, b = (draw_patches(s, 7, 4000, seed) for s in (first, second))
    if not (len(a) and len(b)):
        return float("nan"), float("nan")
    square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2.0 * a @ b.T
    near, far = (np.sqrt(square.min(k).clip(0.0) / a.shape[1]).mean() for k in (1, 0))
    return float(near), float(far)


def draw_patches(slices: Sequence[Slice], patch: int, samples: int, seed: int) -> np.ndarray:
    """Lab patches [n, 3 patch^2] float32 that lie wholly inside the masks, at most ``samples``."""
    centers: list[np.ndarray] = []
    half = patch // 2
    for number, (_, mask) in enumerate(slices):
        whole = ndimage.binary_erosion(mask, np.ones((patch, patch)))
        found = np.argwhere(whole)
        centers.append(np.concatenate([np.full((len(found), 1), number), found], 1))
    table = np.concatenate(centers) if centers else np.zeros((0, 3), int)
    if len(table) > samples:
        table = table[np.random.default_rng(seed).permutation(len(table))[:samples]]
    parts = [np.zeros((0, 3 * patch * patch), np.float32)]
    window = np.arange(-half, half + 1)
    for number, (image, _) in enumerate(slices):
        place = table[table[:, 0] == number]
        lab = rgb_to_lab(image)
        rows = place[:, 1, None, None] + window[:, None]
        columns = place[:, 2, None, None] + window[None]
        parts.append(lab[rows, columns].reshape(len(place), 3 * patch * patch).astype(np.float32))
    return np.concatenate(parts)


def half_size(slices: Sequence[Slice]) -> list[Slice]:
    """The slices at half the pixels along each side; a pixel counts when all four of it did."""
    result: list[Slice] = []
    for image, mask in slices:
        height, width = (s // 2 * 2 for s in mask.shape)
        blocks = image[:height, :width].reshape(height // 2, 2, width // 2, 2, -1)
        share = mask[:height, :width].reshape(height // 2, 2, width // 2, 2).mean((1, 3))
        result.append((blocks.mean((1, 3)), share == 1.0))
    return result


def volume_slices(
    rgb: np.ndarray, inside: np.ndarray, per_axis: int = 4, axes: Sequence[int] = (0, 1, 2)
) -> list[Slice]:
    """Evenly spaced slices through the matter, across each axis."""
    slices = []
    for axis in axes:
        filled = np.flatnonzero(inside.any(tuple(i for i in range(3) if i != axis)))
        for place in np.linspace(0.25, 0.75, per_axis):
            k = int(filled[0] + place * (filled[-1] - filled[0]))
            slices.append((np.take(rgb, k, axis), np.take(inside, k, axis)))
    return slices


def sharpness(slices: Sequence[Slice]) -> float:
    """Mean squared difference between adjacent pixels of slices (Lab units squared)."""
    total, count = 0.0, 0
    for image, mask in slices:
        lab = rgb_to_lab(image)
        for axis in (0, 1):
            both = np.diff(mask.astype(np.int8), axis=axis) == 0
            both &= np.take(mask, range(1, mask.shape[axis]), axis)
            step = (np.diff(lab, axis=axis) ** 2).sum(-1)[both]
            total += float(step.sum())
            count += len(step)
    return total / max(count, 1)


def radial_ratio(domain: InteriorDomain, rgb: np.ndarray) -> float:
    """Change of colour along the depth gradient over the change across it.

    Copied surface colours run inward as streaks: the ratio is then far below that of the material.

    Args:
        domain: Where the matter is and how deep.
        rgb: Colours [X, Y, Z, 3]; those nearer the surface than three voxels do not count.

    Returns:
        Ratio of root mean squares; per direction, so that isotropic matter gives 1.
    """
    deep = domain.depth >= 3.0
    if not deep.any():
        return float("nan")
    smooth = ndimage.gaussian_filter(domain.depth, 1.5)
    normal = np.stack([np.gradient(smooth, axis=k)[deep] for k in range(3)], -1)
    length = np.linalg.norm(normal, axis=1)
    clear = length > 0.3  # on the ridge of the depth there is no inward direction
    if not clear.any():
        return float("nan")
    normal = normal[clear] / length[clear, None]
    lab = rgb_to_lab(rgb)
    along, whole = 0.0, 0.0
    for channel in range(3):
        step = np.stack([np.gradient(lab[..., channel], axis=k)[deep][clear] for k in range(3)], -1)
        along += float(((step * normal).sum(1) ** 2).mean())
        whole += float((step**2).sum(1).mean())
    return float(np.sqrt(along / max(0.5 * (whole - along), 1e-12)))


def depth_profile_difference(
    domain: InteriorDomain, rgb: np.ndarray, other: InteriorDomain, other_rgb: np.ndarray
) -> float:
    """Difference of two volumes' mean colours at equal relative depth, over the colour range.

    Returns:
        Mean over 16 depth ranges of the Lab distance between the mean colours, relative to the
        span of the second volume's colours (1st to 99th percentile, all channels together).
    """
    theirs = rgb_to_lab(other_rgb[other.inside])
    low, high = np.quantile(theirs, [0.01, 0.99], axis=0)
    own = _profile(domain.depth[domain.inside], rgb[domain.inside])
    reference = _profile(other.depth[other.inside], other_rgb[other.inside])
    difference = float(np.nanmean(np.linalg.norm(own - reference, axis=1)))
    return difference / max(float(np.linalg.norm(high - low)), 1e-6)


def depth_profile_error(domain: InteriorDomain, rgb: np.ndarray, exemplar: Exemplar) -> float:
    """Mean Lab difference between the colours at equal relative depth of volume and photograph."""
    own = _profile(domain.depth[domain.inside], rgb[domain.inside])
    other = _profile(exemplar.depth[exemplar.mask], exemplar.image[exemplar.mask])
    return float(np.nanmean(np.linalg.norm(own - other, axis=1)))


def _profile(depth: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    bins = 16
    which = np.clip((depth / max(float(depth.max()), 1e-9) * bins).astype(int), 0, bins - 1)
    lab = rgb_to_lab(rgb)
    count = np.bincount(which, minlength=bins).astype(float)
    count[count == 0] = np.nan
    return np.stack([np.bincount(which, lab[:, c], bins) / count for c in range(3)], 1)


def neighbour_change(rgb: np.ndarray, inside: np.ndarray) -> list[float]:
    """Mean absolute change of colour from slice to slice across x, y and z."""
    change = []
    for axis in range(3):
        both = np.take(inside, range(1, inside.shape[axis]), axis) & np.take(
            inside, range(inside.shape[axis] - 1), axis
        )
        step = np.abs(np.diff(rgb, axis=axis)).mean(-1)
        change.append(float(step[both].mean()) if both.any() else 0.0)
    return change


def neighbour_slice_ratio(rgb: np.ndarray, inside: np.ndarray) -> list[float]:
    """Change from slice to slice per axis over the change across the others; about 1 in a solid.

    Slices made one by one flicker: the ratio across their axis is then well above 1.
    """
    change = neighbour_change(rgb, inside)
    ratios = []
    for axis in range(3):
        others = [change[i] for i in range(3) if i != axis]
        ratios.append(change[axis] / max(float(np.mean(others)), 1e-9))
    return ratios
