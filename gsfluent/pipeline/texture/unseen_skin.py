"""Skin that no photograph showed: the closed side of a solid, black with contact shadow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsfluent._lazy import ndimage
from gsfluent.colors import rgb_to_lab
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, nearest_in

_DARK = 0.5  # lightness over that of the rest of the skin, below which an unseen place is shadow
_FACING = 0.3  # cosine between outward normal and the closed side


def mend_unseen_skin(
    domain: InteriorDomain, closed_side: Sequence[float] | None
) -> tuple[InteriorDomain, float]:
    """Give the dark skin of an unseen underside the colour of the nearest skin that was seen.

    Where ``Fill`` closed a side that no camera looked at, the splats nearest to the new surface are
    those of the contact shadow at its rim: black, and in a cut a black line. Voxels of the shell
    that face that side, lie beyond the middle and are less than half as light as the rest of the
    skin take the colour of the nearest others. The splats themselves stay as they are.

    Args:
        domain: The solid's voxels.
        closed_side: Direction of the closed side [3] in grid axes, from the fill report, or None.

    Returns:
        The domain with mended skin, and the share of the shell that was mended.
    """
    if closed_side is None or not domain.shell.any():
        return domain, 0.0
    side = np.asarray(closed_side, dtype=float)
    if side.shape != (3,) or not np.isfinite(side).all() or np.linalg.norm(side) < 1e-6:
        return domain, 0.0
    side = side / np.linalg.norm(side)
    index = np.argwhere(domain.shell)
    height = index @ side
    below = height > 0.5 * (height.min() + height.max())
    slope = np.stack(np.gradient(ndimage.gaussian_filter(domain.inside.astype(float), 2.0)), -1)
    outward = -slope[domain.shell]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-9
    light = rgb_to_lab(domain.skin[domain.shell])[:, 0]
    dark = below & (light < _DARK * np.median(light[~below]))
    unseen = dark & (outward @ side > _FACING)
    # pits and humps of the closing face elsewhere, but hang together with the rest of it
    grid = np.zeros(domain.inside.shape, bool)
    grid[tuple(index[dark].T)] = True
    labels, count = ndimage.label(grid, np.ones((3, 3, 3)))
    if count == 0:
        return domain, 0.0
    own = labels[tuple(index.T)]
    share = np.bincount(own[dark], unseen[dark], count + 1)
    size = np.maximum(np.bincount(own[dark], minlength=count + 1), 1)
    bad = dark & (share[own] > 0.3 * size[own])
    if not bad.any() or bad.all():
        return domain, 0.0
    good = np.zeros(domain.inside.shape, bool)
    good[tuple(index[~bad].T)] = True
    return replace(domain, skin=domain.skin[nearest_in(good)]), float(bad.mean())
