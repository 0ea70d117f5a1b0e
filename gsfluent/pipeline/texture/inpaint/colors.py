"""Colours of inpainted slices: what the first pass starts from, and back to the photograph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsfluent.pipeline.texture.photo.exemplar import Exemplar
from gsfluent.pipeline.texture.photo.profile import (
    depth_profile,
    match_colors,
    profile_volume,
    surface_profile,
)
from gsfluent.pipeline.texture.volume.domain import InteriorDomain


def match_slices(
    images: np.ndarray,
    level: InteriorDomain,
    axis: int,
    positions: Sequence[int],
    photo: Exemplar | None,
    seed: int,
) -> np.ndarray:
    """Slices with the photograph's colours at each depth; without one, with the stack's cast.

    Slices are those across ``axis`` at ``positions``, float32 [K, H, W, 3], of the object at their
    own resolution; pixels that were not painted come back as they are.
    """
    inside, shell, depth = (
        np.moveaxis(np.take(field, positions, axis), axis, 0)
        for field in (level.inside, level.shell, level.depth)
    )
    hole = inside & ~shell
    if not hole.any():
        return images
    result = images.copy()
    rng = np.random.default_rng(seed)
    typical = None if photo is not None else _profile_of(images[hole], depth[hole])
    for k, open_ in enumerate(hole):
        if open_.sum() < 32:  # too few pixels for a distribution
            continue
        own = images[k][open_]
        if photo is not None:
            result[k][open_] = to_photo(
                own, depth[k][open_], level, photo, int(rng.integers(2**31))
            )
        elif typical is not None:
            # a cast of its own is what makes a slice flicker; its contrast is left alone
            expected = profile_volume(depth[k][open_], *typical)
            result[k][open_] = (own + (expected - own).mean(0)).clip(0.0, 1.0)
    return result


def _profile_of(colors: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour [B, 3] at depths [B]."""
    order = depth.argsort(kind="stable")
    parts = np.array_split(order, min(12, len(order)))
    return (
        np.array([depth[p].mean() for p in parts]),
        np.stack([colors[p].mean(0) for p in parts]),
    )


def initial_volume(level: InteriorDomain, photo: Exemplar | None) -> np.ndarray:
    """Volume that the first pass starts from: colours by depth."""
    if photo is None:
        return surface_profile(level)
    if not photo.silhouette:
        mean = photo.image[photo.mask].mean(0)
        return np.broadcast_to(mean, (*level.inside.shape, 3)).astype(np.float32)
    position, color = depth_profile(photo)
    relative = level.depth * photo.max_depth / max(level.max_depth, 1e-6)
    return profile_volume(relative, position, color)


def to_photo(
    colors: np.ndarray, depth: np.ndarray, level: InteriorDomain, photo: Exemplar, seed: int
) -> np.ndarray:
    """Bring colours [n, 3] back to the photograph's, within depth ranges when it has an outline."""
    if photo.silhouette:
        relative = depth * photo.max_depth / max(level.max_depth, 1e-6)
        own, bins = photo.depth[photo.mask], 8
    else:
        relative, own, bins = np.zeros(len(colors)), np.zeros(int(photo.mask.sum())), 1
    return match_colors(
        colors,
        relative,
        photo.image[photo.mask],
        own,
        bins=bins,
        rng=np.random.default_rng(seed),
        rounds=2,
    )
