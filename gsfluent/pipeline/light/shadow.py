"""Percentage-closer soft shadows from the lamps' depth-and-opacity maps, per point.

Fernando 2005: blockers within the disc that the lamp could be seen through give a mean depth, that
depth and the lamp's size give the width of the penumbra, and blocking is averaged over it. Exact
for a flat blocker parallel to a flat lamp. The model of the fused kernel: no statement waits for
the device, every point is on its own. How lamps and cameras are packed:
:mod:`gsfluent.pipeline.light.shade`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

SEARCH_TAPS = 16
FILTER_TAPS = 32
# Texels: the smallest disc searched for blockers, and the smallest averaged over (it smooths the
# staircase of the map's texels).
LEAST_SEARCH = 2.0
LEAST_FILTER = 1.2
# Where the looks at a disc of that size meet nothing, discs this many times narrower are searched,
# this often.
NARROWER, NARROWINGS = 4.0, 4
# Share of the map's side: the largest disc.
MOST_SPREAD = 0.25
# A blocker this opaque counts for the deepest one: of a body, what limits the light is its rim, and
# of what the lamp sees of a body the rim is deepest. Half way there from the mean fits best.
SURE = 0.3
# A surface steeper than this against the lamp is treated as if it were this steep when the depth it
# would have at a neighbouring texel is taken from its plane.
STEEPEST = 4.0
# Points are lifted off the surface by this many biases before they look at the lamp: splats are
# bumps, and at a slant one would shadow the next.
NORMAL_OFFSET = 1.0
# A blocker counts in full from this many biases past the bias. The skin of a reconstruction is
# several translucent layers, of which camera and lamp see different ones: where the distance
# between them crosses the bias is no edge of anything.
FADE = 4.0
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
_TINY = 1e-12


class ShadowMaps(NamedTuple):
    """What the lamps see, all maps of one size.

    Attributes:
        depth: Expected depth of the splats [m], 0 where nothing is, [M, S, S].
        alpha: Opacity, [M, S, S].
        cameras: Packed cameras, [M, MAP].
    """

    depth: Tensor
    alpha: Tensor
    cameras: Tensor


def disc(taps: int) -> list[tuple[float, float]]:
    """Points of Vogel's spiral: ``taps`` points of equal share of the unit disc."""
    radius = [math.sqrt((i + 0.5) / taps) for i in range(taps)]
    return [(r * math.cos(i * _GOLDEN), r * math.sin(i * _GOLDEN)) for i, r in enumerate(radius)]


def transmittance(
    points: Tensor, normal: Tensor, lamp: Tensor, maps: ShadowMaps, *, biased: float = 1.0
) -> Tensor:
    """Share of one lamp's light that reaches points [..., 3] with unit normals, [...] in [0, 1].

    Points behind the lamp are lit. The depth that the surface itself would have at each tap comes
    from its tangent plane, so that wide discs do not make a slanted surface shadow itself.

    Args:
        points: Scene points [m].
        normal: Unit normals; zero turns the tangent plane off.
        lamp: One row of the packed lamps, [LAMP].
        maps: The shadow maps.
        biased: Factor on the maps' bias; 0 for a receiver that is not in the maps.
    """
    size = maps.depth.shape[-1]
    flat_depth, flat_alpha = maps.depth.reshape(-1), maps.alpha.reshape(-1)
    first = lamp[10].clamp(min=0.0).long()
    face = first + _face(points, lamp, maps.cameras, first)
    row = maps.cameras[face]
    turn = row[..., :12].reshape(*row.shape[:-1], 3, 4)
    raised = points + (NORMAL_OFFSET * biased) * row[..., 14:15] * normal
    local = (turn[..., :3] @ raised[..., None])[..., 0] + turn[..., 3]
    plane = (turn[..., :3] @ normal[..., None])[..., 0]
    depth, focal, nearest, bias = local[..., 2], row[..., 12], row[..., 13], biased * row[..., 14]
    safe = depth.clamp(min=_TINY)
    u, v = local[..., 0] / safe, local[..., 1] / safe
    level = (plane * local).sum(-1)  # n.p: below zero on a surface that faces the lamp
    per_depth = focal / safe  # texels per metre at the point
    hardness = 1.0 / (FADE * bias).clamp(min=_TINY)
    base = face * (size * size)
    most = MOST_SPREAD * size

    def own_depth(du: Tensor, dv: Tensor) -> Tensor:
        """Depth of the surface's tangent plane, du and dv texels off."""
        tu, tv = u + du / focal, v + dv / focal
        denominator = plane[..., 0] * tu + plane[..., 1] * tv + plane[..., 2]
        along = level / torch.where(denominator < -_TINY, denominator, -1.0)
        room = STEEPEST * (du * du + dv * dv).sqrt() / per_depth
        along = torch.where(denominator < -_TINY, along, depth)
        along = torch.minimum(torch.maximum(along, depth - room), depth + room)
        return torch.where(level < 0.0, along, depth)

    def at(column: Tensor, line: Tensor) -> Tensor:
        """Index of a texel; off the map, of the nearest on its border, where nothing is."""
        across, down = column.clamp(0, size - 1).long(), line.clamp(0, size - 1).long()
        return base + down * size + across

    x, y = u * focal + 0.5 * size, v * focal + 0.5 * size
    point = lamp[0] > 0.5
    # how far blockers as near to the lamp as possible could spread, in texels
    closest = torch.minimum(nearest, safe)
    search = lamp[9] * (depth - closest) * per_depth
    search = torch.where(point, search / closest.clamp(min=_TINY), search)
    search = search.clamp(LEAST_SEARCH, most)
    weight, total, deepest = (torch.zeros_like(depth) for _ in range(3))
    for _ in range(NARROWINGS + 1):
        # something high above widens the disc for all that lies below it, and its looks miss that
        lost = ~(weight > 0.0)
        for a, b in disc(SEARCH_TAPS):
            du, dv = a * search, b * search
            index = at((x + du).floor(), (y + dv).floor())
            found = flat_depth[index]
            before = (own_depth(du, dv) - bias - found) * hardness
            share = torch.where(lost, flat_alpha[index] * before.clamp(0.0, 1.0), 0.0)
            weight, total = weight + share, total + share * found
            deepest = torch.maximum(deepest, torch.where(share > SURE, found, 0.0))
        search = (search / NARROWER).clamp(min=LEAST_SEARCH)
    mean = total / weight.clamp(min=_TINY)
    blocker = 0.5 * (mean + torch.maximum(mean, deepest))
    spread = lamp[9] * (depth - blocker).clamp(min=0.0) * per_depth
    spread = torch.where(point, spread / blocker.clamp(min=_TINY), spread)
    spread = spread.clamp(LEAST_FILTER, most)
    blocked = torch.zeros_like(depth)
    for a, b in disc(FILTER_TAPS):
        du, dv = a * spread, b * spread
        limit = own_depth(du, dv) - bias
        column, line = x + du - 0.5, y + dv - 0.5
        left, top = column.floor(), line.floor()
        fx, fy = column - left, line - top
        for dx, wx in ((0.0, 1.0 - fx), (1.0, fx)):
            for dy, wy in ((0.0, 1.0 - fy), (1.0, fy)):
                index = at(left + dx, top + dy)
                before = ((limit - flat_depth[index]) * hardness).clamp(0.0, 1.0)
                blocked += wx * wy * flat_alpha[index] * before
    hit = (depth > 0.0) & (weight > 0.0) & (lamp[10] >= 0.0)
    return torch.where(hit, 1.0 - (blocked / FILTER_TAPS).clamp(0.0, 1.0), 1.0)


def _face(points: Tensor, lamp: Tensor, cameras: Tensor, first: Tensor) -> Tensor:
    """Which of the lamp's maps looks at each point, int64 [...]: that in which it is deepest."""
    if cameras.shape[0] < 6:
        return torch.zeros(points.shape[:-1], dtype=torch.long, device=points.device)
    count = lamp[11].long().clamp(min=1)
    offsets = torch.minimum(torch.arange(6, device=points.device), count - 1)
    rows = cameras[first + offsets]
    return (points @ rows[:, 8:11].T + rows[:, 11]).argmax(-1).clamp(max=5) * (count > 1)
