"""Sheets of liquid that tear.

A sheet in air that is thinner than the points can carry is torn by its surface tension: holes in
half a millimetre of water grow at sqrt(2 sigma / (rho t)) = 0.5 m/s (Taylor 1959, Culick 1960), two
spacings between two looks, and leave strands and drops. A film on a solid or on the floor wets it,
and stays; so does one of milk, whose proteins hold its surface, and of what is thicker.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.materials import Material
from gsfluent.pipeline.matter.points import Matter
from gsfluent.scene.scene import Scene
from gsfluent.spatial.neighbours import nearest_rows

WETS = 4.0
"""Distance from a solid or the floor within which a sheet lies on it [spacings]."""
THIN = (0.35, 0.6)
"""Thickness up to which a sheet surely tears, and from which on it holds, in :data:`SHEET` or in
spacings, whichever are more."""
SHEET = 1e-3
"""However fine the points, a sheet thinner than about this [m] meets a drop, a bubble or a ripple
that pierces it."""
DROP = 0.75
"""Distance to which points of a torn sheet draw together [spacings]: nearly that inside a drop."""
GRASP = 3.0
"""Distance within which they do [spacings]."""

CLEAN = 1.5e-3
"""Viscosity [Pa s] up to which a liquid is taken for one like water: nothing holds its surface."""


def tears(material: Material) -> bool:
    """Whether thin sheets of a liquid tear."""
    viscosity = material.viscosity
    return viscosity is None or bool((torch.as_tensor(viscosity) <= CLEAN).all())


def in_air(position: Tensor, solid: Tensor, spacing: float, floor: float | None) -> Tensor:
    """Points of a liquid that lie on nothing, bool [N].

    Args:
        position: Of the liquid [m], [N, 3].
        solid: Points of solids [m], [M, 3].
        spacing: Of the points of the liquid inside it [m].
        floor: Height of the floor [m]; None without one.
    """
    reach = WETS * spacing
    free = torch.ones_like(position[:, 0], dtype=torch.bool)
    if floor is not None:
        free &= position[:, 2] > floor + reach
    if solid.shape[0]:
        low, high = solid.amin(dim=0) - reach, solid.amax(dim=0) + reach
        near = free & ((position > low) & (position < high)).all(dim=1)
        rows = near.nonzero()[:, 0]
        if rows.numel():
            away = nearest_rows(solid, position[rows], 1, reach)[0][:, 0]
            free = free.index_copy(0, rows, away > reach)
    return free


def thinness(apart: Tensor, spacing: float) -> Tensor:
    """0 in a sheet that holds to 1 in one that tears, from the distance of its points [m]."""
    low, high = THIN
    thickness = spacing**3 / apart.square() / max(spacing, SHEET)
    return ((high - thickness) / (high - low)).clamp(0.0, 1.0)


def wetted(matter: Matter, scene: Scene) -> Tensor:
    """Points that a liquid wets, int64 [S]."""
    solid = [body.solid is not None for body in scene.bodies]
    body = matter.particles.body.long()
    wets = torch.tensor(solid, dtype=torch.bool, device=body.device)[body]
    return (wets & ~matter.of_law("fluid")).nonzero()[:, 0]
