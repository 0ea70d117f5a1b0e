"""Is the inside made of what the surface shows? Then the surface is the best photograph there is.

Three questions, in the order of their cost. Do the surface's colours have the photograph's
distribution? Do patches of the surface look like patches of the photograph, as far as one half of
the photograph looks like its other half? And, when the surface is copied inwards, does the inside
show streaks along the depth that the photograph does not show? Two times yes means that the surface
is kept and the inside is grown from it; three times yes, that copying is all there is to do.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsfluent._lazy import ndimage
from gsfluent.colors import rgb_to_lab
from gsfluent.pipeline.texture.photo.metrics import lab_histogram_distance
from gsfluent.pipeline.texture.synthesis.guides import PlacedPhoto
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, gradient

_PATCH = 5
_ALLOWED = 1.5  # times the distance between the halves of the photograph
_EQUAL = 0.6  # Lab units that nobody sees
_STREAKS = 0.75  # least share of the photograph's change along the depth


def surface_verdict(
    domain: InteriorDomain, photos: list[PlacedPhoto], seed: int = 0
) -> dict[str, Any]:
    """Compare the surface, and the surface copied inwards, with the photographs of the inside.

    Returns:
        ``surface_hist``, ``surface_patch`` (distance surface to photograph, Lab; None where no
        patch of the surface is flat enough to be seen from along an axis), ``photo_hist`` and
        ``photo_patch`` (between the photograph's halves), ``copy_radial`` and ``photo_radial``
        (change along the depth over change across it), ``surface_like_interior`` and
        ``copy_suffices``.
    """
    rng = np.random.default_rng([seed, 5])
    halves: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    colors: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    radial = []
    for placed in photos:
        image, mask, depth, _ = placed.at(1.0)
        lab = rgb_to_lab(image)
        tile = max(8, min(mask.shape) // 6)
        u, v = np.indices(mask.shape)
        which = (u // tile + v // tile) % 2
        for k in range(2):
            part = mask & (which == k)
            halves[k].append(_patches(lab, part, rng))
            colors[k].append(image[part])
        radial.append(_radial(lab, depth, mask))
    first, second = (np.concatenate(c) for c in colors)
    # a picture smaller than a tile has one half only
    photo_hist = lab_histogram_distance(first, second) if len(first) and len(second) else 0.0
    both = [np.concatenate(h) for h in halves]
    photo_patch = _distance(both[0], both[1], rng)
    shown = np.concatenate(colors[0] + colors[1])
    surface_hist = lab_histogram_distance(domain.skin[domain.shell], shown)
    skin_lab = rgb_to_lab(domain.skin)
    surface_patch = _distance(_surface_patches(domain, skin_lab, rng), np.concatenate(both), rng)
    alike = surface_hist <= max(_ALLOWED * photo_hist, _EQUAL)
    if np.isfinite(surface_patch):
        alike = alike and surface_patch <= max(_ALLOWED * np.nan_to_num(photo_patch), _EQUAL)
    copy_radial, photo_radial = _radial(skin_lab, domain.depth, domain.inside), np.mean(radial)
    return {
        "surface_hist": surface_hist,
        "photo_hist": photo_hist,
        "surface_patch": surface_patch if np.isfinite(surface_patch) else None,
        "photo_patch": photo_patch if np.isfinite(photo_patch) else None,
        "copy_radial": copy_radial,
        "photo_radial": float(photo_radial),
        "surface_like_interior": bool(alike),
        "copy_suffices": bool(alike and copy_radial >= _STREAKS * photo_radial),
    }


def _patches(lab: np.ndarray, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Patches [n, 75] of a picture that lie wholly in a mask."""
    half = _PATCH // 2
    centers = np.argwhere(ndimage.binary_erosion(mask, np.ones((_PATCH, _PATCH))))
    centers = centers[rng.permutation(len(centers))[:3000]]
    window = np.arange(-half, half + 1)
    rows = centers[:, 0, None, None] + window[:, None]
    columns = centers[:, 1, None, None] + window
    return lab[rows, columns].reshape(len(centers), 3 * _PATCH**2)


def _surface_patches(
    domain: InteriorDomain, skin: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Patches [n, 75] of the surface where it faces along an axis of the grid."""
    slope = gradient(domain.depth)
    length = np.linalg.norm(slope, axis=0)
    near = domain.inside & (domain.depth > 1.0) & (domain.depth < 3.0)
    half = _PATCH // 2
    window = np.arange(-half, half + 1)
    result = []
    for axis in range(3):
        flat = near & (np.abs(slope[axis]) > 0.94 * np.maximum(length, 1e-6)) & (length > 0.3)
        centers = np.argwhere(flat)
        centers = centers[rng.permutation(len(centers))[:3000]]
        rows, columns = (i for i in range(3) if i != axis)
        fits = np.ones(len(centers), bool)
        for i in (rows, columns):
            fits &= (centers[:, i] >= half) & (centers[:, i] < domain.inside.shape[i] - half)
        centers = centers[fits]
        index = [centers[:, k, None, None] for k in range(3)]
        index[rows] = index[rows] + window[:, None]
        index[columns] = index[columns] + window
        place = tuple(np.broadcast_arrays(*index))
        whole = domain.inside[place].all((1, 2))
        result.append(skin[place].reshape(len(centers), 3 * _PATCH**2)[whole][:1500])
    return np.concatenate(result)


def _distance(first: np.ndarray, second: np.ndarray, rng: np.random.Generator) -> float:
    """Sliced Wasserstein distance of two sets of patches; NaN when one is nearly empty."""
    if min(len(first), len(second)) < 64:
        return float("nan")
    direction = rng.standard_normal((first.shape[1], 64))
    direction /= np.linalg.norm(direction, axis=0)
    steps = np.linspace(0.005, 0.995, 100)
    a = np.quantile(first @ direction, steps, axis=0)
    b = np.quantile(second @ direction, steps, axis=0)
    return float(np.abs(a - b).mean())


def _radial(lab: np.ndarray, depth: np.ndarray, inside: np.ndarray) -> float:
    """Mean change of colour along the depth over that across it; 1 when there is no change."""
    dimensions = depth.ndim
    slope = gradient(depth)
    length = np.linalg.norm(slope, axis=0)
    steep = inside & (length > 0.5) & (depth > 2.0)
    if not steep.any():
        return 1.0
    normal = (slope / np.maximum(length, 1e-6))[:, steep]
    along, total = 0.0, 0.0
    for c in range(3):
        change = gradient(lab[..., c])[:, steep]
        part = (change * normal).sum(0)
        along += float((part**2).sum())
        total += float((change**2).sum())
    across = (total - along) / max(dimensions - 1, 1)
    if total < 1e-3 * len(normal[0]):
        return 1.0
    return float(np.sqrt(along / max(across, 1e-9)))
