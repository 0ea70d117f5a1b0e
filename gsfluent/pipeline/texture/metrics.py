"""How like the exemplar (or the truth) an interior looks: statistics that need no downloads.

Pixel-wise measures are useless here: a blurred depth profile beats a second, equally true fruit in
PSNR. What is compared instead are distributions: of patches, of colours, of colours per depth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .domain import InteriorDomain
from .photo import Exemplar, rgb_to_lab

__all__ = [
    "depth_profile_error",
    "lab_histogram_distance",
    "neighbour_slice_ratio",
    "patch_distance",
    "volume_slices",
]

Slice = tuple[np.ndarray, np.ndarray]
"""An image [H, W, 3] in 0..1 and its mask [H, W]."""


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
    projections: int = 128,
    samples: int = 6000,
    seed: int = 0,
) -> float:
    """Sliced Wasserstein-1 distance between the Lab patches of two sets of slices (pSWD).

    Args:
        first: Slices with masks; only patches wholly inside the mask count.
        second: The same for the other set.
        patch: Edge of the patches [pixels].
        projections: Random directions.
        samples: Patches drawn per set.
        seed: Seed of directions and draws.

    Returns:
        Distance in Lab units; NaN when a set holds no whole patch.
    """
    rng = np.random.default_rng(seed)
    a, b = (_draw_patches(s, patch, samples, rng) for s in (first, second))
    if len(a) == 0 or len(b) == 0:
        return float("nan")
    direction = rng.standard_normal((a.shape[1], projections))
    direction /= np.linalg.norm(direction, axis=0)
    steps = np.linspace(0.5 / 512, 1 - 0.5 / 512, 512)
    qa = np.quantile(a @ direction, steps, axis=0)
    qb = np.quantile(b @ direction, steps, axis=0)
    return float(np.abs(qa - qb).mean())


def _draw_patches(
    slices: Sequence[Slice], patch: int, samples: int, rng: np.random.Generator
) -> np.ndarray:
    from scipy import ndimage

    centers: list[np.ndarray] = []
    half = patch // 2
    for number, (_, mask) in enumerate(slices):
        whole = ndimage.binary_erosion(mask, np.ones((patch, patch)))
        found = np.argwhere(whole)
        centers.append(np.concatenate([np.full((len(found), 1), number), found], 1))
    table = np.concatenate(centers) if centers else np.zeros((0, 3), int)
    if len(table) == 0:
        return np.zeros((0, 3 * patch * patch))
    table = table[rng.permutation(len(table))[:samples]]
    lab = [rgb_to_lab(image) for image, _ in slices]
    window = np.arange(-half, half + 1)
    rows = [lab[n][r + window[:, None], c + window[None]].reshape(-1) for n, r, c in table.tolist()]
    return np.stack(rows).astype(np.float64)


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


def depth_profile_error(domain: InteriorDomain, rgb: np.ndarray, exemplar: Exemplar) -> float:
    """Mean Lab difference between the colours at equal relative depth of volume and photograph."""
    own = _profile(domain.depth[domain.inside], rgb[domain.inside])
    other = _profile(exemplar.depth[exemplar.mask], exemplar.image[exemplar.mask])
    return float(np.nanmean(np.linalg.norm(own - other, axis=1)))


def _profile(depth: np.ndarray, rgb: np.ndarray, bins: int = 16) -> np.ndarray:
    which = np.clip((depth / max(float(depth.max()), 1e-9) * bins).astype(int), 0, bins - 1)
    lab = rgb_to_lab(rgb)
    count = np.bincount(which, minlength=bins).astype(float)
    count[count == 0] = np.nan
    return np.stack([np.bincount(which, lab[:, c], bins) / count for c in range(3)], 1)


def neighbour_slice_ratio(rgb: np.ndarray, inside: np.ndarray) -> list[float]:
    """Change from slice to slice per axis over the change within slices; about 1 when consistent.

    Slices made one by one flicker: the ratio across their axis is then well above 1.
    """
    change = []
    for axis in range(3):
        both = np.take(inside, range(1, inside.shape[axis]), axis) & np.take(
            inside, range(inside.shape[axis] - 1), axis
        )
        step = np.abs(np.diff(rgb, axis=axis)).mean(-1)
        change.append(float(step[both].mean()) if both.any() else 0.0)
    ratios = []
    for axis in range(3):
        others = [change[i] for i in range(3) if i != axis]
        ratios.append(change[axis] / max(float(np.mean(others)), 1e-9))
    return ratios
