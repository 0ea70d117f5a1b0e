"""How fine the voxels of a solid must be for the grid that will move it."""

from __future__ import annotations

import math

from gsfluent.data import Gaussians

__all__ = ["VOXELS_PER_CELL", "fill_resolution", "visible_extent"]

VOXELS_PER_CELL = 2.0
"""Measured (docs/measured/interior.md): from two on, the mass that sampled points bring to the
cells of a curved surface is limited by the points themselves (3 % of a cell), not by the voxels."""
_PICTURE = 96
"""Voxels along the largest object that its cut faces want, however coarse the simulation is."""
_LEAST, _MOST = 32, 512


def visible_extent(gaussians: Gaussians) -> float:
    """Longest side [world units] of the box of all but the outermost percent of the splats."""
    if gaussians.count == 0:
        return 0.0
    points = gaussians.means.detach().double().T.contiguous().sort(dim=1).values
    margin = gaussians.count // 200
    return float((points[:, gaussians.count - 1 - margin] - points[:, margin]).amax())


def fill_resolution(extent: float, largest: float, cells: int) -> int:
    """Voxels along the longest side of an object.

    All objects of a scene share one grid, so they share one size of voxels: that of the largest
    object, whose longest side the simulation divides into ``cells``.

    Args:
        extent: Longest side of the object.
        largest: Longest side of the largest object of the scene, same unit.
        cells: Grid cells along the largest object.
    """
    whole = max(_PICTURE, math.ceil(VOXELS_PER_CELL * cells))
    share = 1.0 if not largest > 0 else min(1.0, extent / largest)
    return max(_LEAST, min(_MOST, math.ceil(whole * share)))
