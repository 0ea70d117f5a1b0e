"""How points of a liquid are drawn: as flat ellipsoids that lie in the sheet they belong to.

The neighbourhood of a point says what it is part of: inside a pool it is round, in a film flat, in
a jet long. The axes of the splat are those of its weighted covariance (Yu and Turk 2013), its
volume that of the point, and in the film it is wide enough to meet its neighbours. What has few
neighbours is spray, and round.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.geometry import product, quaternion_to_matrix
from gsfluent.pipeline.liquid.depth import deep
from gsfluent.pipeline.liquid.tearing import thinness
from gsfluent.spatial.neighbours import nearest_rows

REACH = 4.0
"""Radius of a neighbourhood, in spacings."""
STRETCHED = 8.0
"""The same where a film is so thin that :data:`FEW` points lie no nearer."""
FEW = 25
"""Points in a neighbourhood below which it has no shape."""
MOST = 36
"""Points of a neighbourhood that are looked at; a film has no more within :data:`REACH`."""
RATIO = 4.0
"""Longest over shortest axis of a splat, at most."""
SMOOTH = 0.9
"""How much of its distance from the middle of its sheet a point is brought nearer."""
SPRAY = 0.5
"""Size of a splat without neighbours over that of one inside."""
CLOSED = 0.6
"""Splats of this many standard deviations per spacing close a packing of points."""
TENSION = 1.5e-3
"""Distance [m] over which surface tension leaves no gap, notch or ripple, however fine the points
are: the capillary length of water and of milk is 2.3 to 2.7 mm. Drops that are finer are a mist,
which casts no shadow."""
FILM = 0.9
"""The same in a film, whose points lie less evenly."""

TORN = 0.75
"""Standard deviation of a splat of a sheet that tears, at most, in spacings."""


class Ellipsoids(NamedTuple):
    """Splats of a liquid.

    Attributes:
        means: Centres [m], [N, 3].
        quats: Orientations ``wxyz``, [N, 4]; the last axis is the normal of the sheet.
        scales: Standard deviations [m], descending, [N, 3].
        shape: Eigenvalues of the neighbourhood over the largest, descending, [N, 3]; one for spray.
        apart: Distance of the neighbours in the sheet [m], [N].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    shape: Tensor
    apart: Tensor


def ellipsoids(position: Tensor, volume: Tensor, free: Tensor | None = None) -> Ellipsoids:
    """Ellipsoids of the points of one liquid.

    Args:
        position: Where the points are [m], [N, 3].
        volume: Their volumes [m^3], [N].
        free: Points in air, bool [N]; none when absent. Where their sheet is so thin that it tears,
            splats do not close it.

    Returns:
        One splat a point, on the device and of the dtype of ``position``. What is seen of them is
        a continuous function of the positions, so that nothing pops; deep points stay round.
    """
    count = position.shape[0]
    edge = volume.double().pow(1.0 / 3.0)
    if count <= FEW:
        return _round(position, edge, SPRAY * CLOSED)
    spacing = float(edge.mean())
    seen = (~deep(position, spacing)).nonzero()[:, 0]
    made = _round(position, edge, CLOSED)
    if seen.numel() == 0:
        return made
    shaped = _shaped(position.double(), seen, edge[seen], spacing, free)
    pairs = zip(made, shaped, strict=True)
    return Ellipsoids(*(a.index_copy(0, seen, b.to(a)) for a, b in pairs))


def _shaped(
    everywhere: Tensor, rows: Tensor, edge: Tensor, spacing: float, free: Tensor | None
) -> Ellipsoids:
    """Ellipsoids of some points among all."""
    count, places = everywhere.shape[0], everywhere[rows]
    distance, index = nearest_rows(everywhere, places, min(MOST, count), 2.0 * spacing)
    # As far as REACH where that holds enough points, farther in a film stretched thin; where it
    # holds more than are looked at, only as far as those.
    reach = distance[:, FEW - 1 : FEW].clamp(REACH * spacing, STRETCHED * spacing)
    if count > MOST:
        reach = torch.minimum(reach, distance[:, -1:].clamp(min=1e-3 * spacing))
    near = (distance / reach).clamp(max=1.0)
    weight = 1.0 - near**3
    weight = weight / weight.sum(dim=1, keepdim=True)
    arm = everywhere[index] - places[:, None]
    middle = (weight[..., None] * arm).sum(dim=1)
    arm = arm - middle[:, None]
    covariance = torch.einsum("nk,nki,nkj->nij", weight, arm, arm)
    packed = covariance.flatten(1)[:, [0, 4, 8, 1, 2, 5]]
    # the library's own solver of many matrices gives up on a GPU now and then
    quats, deviation = ops.covariance_axes(packed.contiguous())
    value, axes = deviation.square().clamp(min=1e-30), quaternion_to_matrix(quats)
    # From nothing at half of FEW to everything at FEW: a neighbourhood gets its shape gently.
    inside = (distance <= reach).sum(dim=1).double()
    known = ((inside - 0.5 * FEW) / (0.5 * FEW)).clamp(0.0, 1.0)[:, None]
    shape = value / value[:, :1]
    shape = torch.lerp(torch.ones_like(shape), shape, known)
    # Toward the middle of the sheet, not along it.
    flat = torch.einsum("nji,nj->ni", axes, middle) * (1.0 - shape)
    means = places + SMOOTH * torch.einsum("nij,nj->ni", axes, flat)
    long = shape.clamp(min=1.0 / RATIO)
    size = torch.lerp(torch.full_like(known, SPRAY), torch.ones_like(known), known)
    volume_left = (CLOSED * edge[:, None] * size) ** 3
    scales = long * (volume_left / product(long)[:, None]).pow(1.0 / 3.0)
    # In a film of n points on the disc of the neighbourhood each has reach^2 pi / n.
    sheet = reach * (torch.pi / inside[:, None].clamp(min=1.0)).sqrt()
    thin = known * (1.0 - shape[:, 2:]) * (2.0 * shape[:, 1:2]).clamp(max=1.0)
    wide = torch.maximum(scales[:, :2], thin * FILM * sheet)
    if free is not None:
        torn = torch.where(free[rows, None], thinness(sheet, spacing), 0.0)
        wide = torch.lerp(wide, wide.clamp(max=TORN * spacing), torn)
    thick = volume_left / product(wide)[:, None]
    thick = torch.maximum(thick, wide[:, :1] / RATIO)
    thick = torch.minimum(thick, wide[:, 1:])
    scales = torch.cat([wide, thick], dim=1)
    return Ellipsoids(means, quats, scales, shape, sheet[:, 0])


def _round(position: Tensor, edge: Tensor, sigma: float) -> Ellipsoids:
    """Balls, of a standard deviation in edges: spray, and what lies deep."""
    count = position.shape[0]
    size = (sigma * edge)[:, None].expand(count, 3)
    quats = position.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    ones = torch.ones_like(position)
    return Ellipsoids(
        position, quats.contiguous(), size.to(position).contiguous(), ones, edge.to(position)
    )
