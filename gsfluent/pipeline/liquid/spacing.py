"""Points of a liquid that have run together, pushed apart again.

What the grid cannot see - motion of points within its cells - is not resisted by pressure, and
points of a stretched film gather in clumps and leave holes. They are moved apart as in Ando,
Thuerey and Tsuruno (2012), pair by pair and equally, so that the centre of mass stays; velocities
are not touched. A sheet that tears (:mod:`gsfluent.pipeline.liquid.tearing`) is drawn together into
strands and drops in the same way.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.pipeline.liquid.depth import deep
from gsfluent.pipeline.liquid.tearing import DROP, GRASP, thinness
from gsfluent.spatial.neighbours import nearest_rows

NEIGHBOURS = 12
SHARE = 0.25
"""Share of what is missing that a pair is moved at a time."""


def apart(position: Tensor, spacing: float, free: Tensor | None = None) -> Tensor:
    """Positions of points moved away from those that are too near; deep ones are left alone.

    Too near is nearer than the mean distance that the twelve nearest neighbours would have in a
    plane: 0.7 spacings inside a liquid, and the distance in the sheet in a sheet.

    Args:
        position: Points of equal mass [m], float64 [N, 3].
        spacing: Their distance inside the liquid [m].
        free: Points in air, whose sheets tear where they are thin, bool [N]; none when absent.

    Returns:
        Where they are put, [N, 3]; their mean is the same.
    """
    count = position.shape[0]
    if count <= NEIGHBOURS:
        return position
    rows = (~deep(position, spacing)).nonzero()[:, 0]
    if rows.shape[0] <= NEIGHBOURS:
        return position
    everywhere, position = position, position[rows]
    distance, index = nearest_rows(position, position, NEIGHBOURS + 1, spacing)
    # Spray is nobody's neighbour.
    reach = distance[:, -1].clamp(max=4.0 * spacing) * math.sqrt(math.pi / NEIGHBOURS)
    distance, index = distance[:, 1:], index[:, 1:]
    wanted = 0.5 * (reach[:, None] + reach[index])
    if free is not None:
        thin = torch.where(free[rows], thinness(reach, spacing), 0.0)
        # both ends: what still holds is not drawn into what tears
        thin = torch.minimum(thin[:, None], thin[index])
        wanted = torch.lerp(wanted, torch.full_like(wanted, DROP * spacing), thin)
    missing = wanted - distance
    pulled = 0.0 if free is None else torch.where(distance < GRASP * spacing, thin * missing, 0.0)
    missing = torch.where(missing > 0.0, missing, pulled)
    way = (position[:, None] - position[index]) / distance.clamp(min=1e-9 * spacing)[..., None]
    # Each pair is seen from one or both ends: a quarter of it to either end each time.
    push = 0.25 * SHARE * missing[..., None] * way
    unit = spacing * 2.0**-40  # sums in whole numbers have no order
    push = (push / unit).round().long()
    moved = push.sum(dim=1)
    moved.index_add_(0, index.reshape(-1), -push.reshape(-1, 3))
    return everywhere.index_add(0, rows, moved.double() * unit)
