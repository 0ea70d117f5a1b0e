"""The lamps' views: depth and opacity of the splats as each lamp sees them, in one call.

A directional lamp looks through a perspective camera 500 scene radii away (its rays differ by 0.1
degrees from parallel). A point lamp outside the matter has one wide map toward it; one close to or
inside it has the six faces of a cube. Maps move in whole texels and change size in steps, so that
the edges of shadows do not swim when the object moves. Where the matter is, is asked of the device
once per picture; all the rest is a few numbers on the host.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from gsfluent import geometry, ops
from gsfluent.data import SPRAY, Gaussians
from gsfluent.pipeline.light.lamps import Lamp, Vector
from gsfluent.pipeline.light.occlusion import Occupancy
from gsfluent.pipeline.light.shade import MAP
from gsfluent.pipeline.light.shadow import ShadowMaps

# Distance of a directional lamp's camera in scene radii.
_FAR = 500.0
# Free border of a map, as a share of the scene's radius.
_BORDER = 1.15
# Steps per doubling in which the size of a directional map changes.
_STEPS = 4.0
# A point lamp farther than this many radii from the middle looks through one map.
_OUTSIDE = 1.6
# Half width of a face of the cube over its distance: past 1, so that the filter has room.
_CUBE = 1.15
# What the lamp's faces look away from: they look along +-x, +-y, +-z.
_CUBE_TOWARD: tuple[Vector, ...] = (
    (-1.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, -1.0),
    (0.0, 0.0, 1.0),
)
# Bias: what is nearer than this many mean splat sizes, plus texels, is the surface itself.
_BIAS_SPLATS = 3.0
_BIAS_TEXELS = 1.0
# The bulk of the matter: at most this many root-mean-square distances from its mean.
_BULK = 3.0
_NEAR = 1e-4
# Shortest over longest axis up to which a grain is one of the sides of a chip, and no mist.
_PLATE = 0.5
# What a picture adds to the variances of a splat, in texels squared.
_BLUR = 0.3


class Bulk(NamedTuple):
    """The matter less what flew far, as the host knows it.

    Attributes:
        center: Mean of the centres [m].
        radius: Radius around it [m].
        size: Mean standard deviation of a splat [m].
    """

    center: Vector
    radius: float
    size: float


def bulk(gaussians: Gaussians) -> Bulk:
    """Find the bulk of the matter; waits for the device once."""
    found = ops.splat_bulk(gaussians.means, gaussians.scales)
    radius = min(found.reach, _BULK * found.spread) + 3.0 * found.size
    return Bulk(found.center, max(radius, 1e-9), found.size)


def faces_of(lamps: tuple[Lamp, ...], matter: Bulk) -> tuple[int, ...]:
    """Shadow maps of each lamp: 0, 1, or 6 for a point lamp close to the matter."""
    counts = []
    for lamp in lamps:
        count = 0
        if lamp.shadow:
            close = lamp.position is not None and math.dist(lamp.position, matter.center) < (
                _OUTSIDE * matter.radius
            )
            count = 6 if close else 1
        counts.append(count)
    return tuple(counts)


def shadow_maps(
    gaussians: Gaussians,
    lamps: tuple[Lamp, ...],
    faces: tuple[int, ...],
    size: int,
    matter: Bulk,
    *,
    groups: Tensor | None = None,
) -> ShadowMaps | None:
    """Render the maps, ``size`` texels wide, of all lamps; None when none casts a shadow.

    Lamps, ``faces`` and matter are what :meth:`gsfluent.pipeline.light.lamps.Lighting.drawn`,
    :func:`faces_of` and :func:`bulk` give; of siblings (``groups`` int32 [N]) only the nearest
    shades. Mist shades nothing: its drops are finer than a texel, which would be all dark. Chips
    are about a texel large, and shade as much less as the map draws them larger.
    """
    if not any(faces):
        return None
    rows, texels = [], []
    for lamp, count in zip(lamps, faces, strict=True):
        if count == 0:
            continue
        if lamp.position is None:
            views, focal, near = _directional(lamp, matter, size)
        else:
            views, focal, near = _point(lamp.position, count, matter, size)
        texels.append((near + matter.radius) / focal)
        bias = _BIAS_SPLATS * matter.size + _BIAS_TEXELS * texels[-1]
        rows += [_row(view, focal, near, bias, size) for view in views]
    opacities = _shading(gaussians, math.fsum(texels) / len(texels))
    # one transfer: each costs more than the little that is in it
    table = torch.stack(rows).to(gaussians.means)
    cameras, intrinsics, bottom = table.split((MAP, 9, 4), 1)
    viewmat = torch.cat([cameras[:, :12], bottom], 1).view(-1, 4, 4)
    seen = ops.rasterize(
        gaussians.means,
        opacities,
        viewmat,
        intrinsics.reshape(-1, 3, 3),
        size,
        size,
        quats=gaussians.quats,
        scales=gaussians.scales,
        colors=opacities[:, None],  # not looked at; the rasterizer wants some
        groups=groups,
        near=_NEAR,
    )
    assert seen.depth is not None  # asked for
    # Looked up beyond a map is its border: a grain that flew there would shade all behind it.
    alpha = functional.pad(seen.alpha[:, 1:-1, 1:-1], (1, 1, 1, 1))
    return ShadowMaps(seen.depth, alpha, cameras)


def _shading(gaussians: Gaussians, texel: float) -> Tensor:
    """Opacities [N] of the splats in maps with texels [m] of this size at the matter."""
    if gaussians.labels is None:
        return gaussians.opacities
    short, long = gaussians.scales.aminmax(dim=1)
    wide = geometry.product(gaussians.scales) / (short * long).clamp(min=1e-30)
    blur = _BLUR * texel * texel
    share = long * wide / ((long * long + blur) * (wide * wide + blur)).sqrt()
    # light has to pass the front of a chip and its back, which shade together as much as they hide
    opaque = gaussians.opacities
    both = 1.0 - (1.0 - share * opaque * (2.0 - opaque)).clamp(min=0.0).sqrt()
    grains = torch.where(short > _PLATE * long, 0.0, both)
    return torch.where(gaussians.labels == SPRAY, grains, opaque)


def _row(view: Tensor, focal: float, near: float, bias: float, size: int) -> Tensor:
    """Packed camera [MAP], intrinsics [9] and last row of the view [4] of one map."""
    half = 0.5 * size
    lens = [focal, 0.0, half, 0.0, focal, half, 0.0, 0.0, 1.0]
    rest = torch.tensor([focal, near, bias, *lens, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    return torch.cat([view.flatten(), rest])


def _directional(lamp: Lamp, matter: Bulk, size: int) -> tuple[list[Tensor], float, float]:
    """View [3, 4], focal length [texels] and nearest depth [m] of a directional lamp."""
    turn = _rotation(lamp.toward)
    stepped = 2.0 ** (math.ceil(math.log2(matter.radius) * _STEPS) / _STEPS)
    texel = stepped * (2.0 * _BORDER / size)
    x, y, z = (turn @ torch.tensor(matter.center, dtype=torch.float64)).tolist()
    distance = _FAR * stepped
    shift = (-round(x / texel) * texel, -round(y / texel) * texel, distance - z)
    return [_view(turn, shift)], 0.5 * size * _FAR / _BORDER, distance - stepped


def _point(
    position: Vector, count: int, matter: Bulk, size: int
) -> tuple[list[Tensor], float, float]:
    """Views [3, 4], focal length [texels] and nearest depth [m] of a point lamp."""
    place = torch.tensor(position, dtype=torch.float64)
    distance = math.dist(position, matter.center)
    near = max(distance - matter.radius, 0.05 * matter.radius)
    if count == 6:
        views = [_view(turn, (-(turn @ place)).tolist()) for turn in map(_rotation, _CUBE_TOWARD)]
        return views, 0.5 * size / _CUBE, near
    x, y, z = (a - b for a, b in zip(position, matter.center, strict=True))
    turn = _rotation((x, y, z))
    sine = min(_BORDER * matter.radius / distance, 0.9)
    focal = 0.5 * size * math.sqrt(1.0 - sine * sine) / sine
    return [_view(turn, (-(turn @ place)).tolist())], focal, near


def _view(turn: Tensor, shift: Sequence[float]) -> Tensor:
    return torch.cat([turn, torch.tensor(shift, dtype=torch.float64)[:, None]], 1)


@functools.lru_cache(maxsize=256)
def _rotation(toward: Vector) -> Tensor:
    """Rotation [3, 3] into the camera of a lamp that shines along minus ``toward``, float64."""
    eye = torch.tensor(toward, dtype=torch.float64)
    along_z = abs(toward[2]) > 0.999 * math.hypot(*toward)
    up = torch.tensor([0.0, 1.0, 0.0] if along_z else [0.0, 0.0, 1.0], dtype=torch.float64)
    return geometry.look_at(eye, torch.zeros_like(eye), up)[:3, :3].double()


@dataclass(frozen=True)
class Lit:
    """What one state of the matter does to the light; shared by all cameras that look at it.

    Attributes:
        lamps: Packed lamps, [L, LAMP].
        environment: Irradiance over pi, [9, 3].
        maps: Shadow maps, or None.
        grid: Occupancy, or None when nothing needs it.
        occlusion: Strength of ambient occlusion.
    """

    lamps: Tensor
    environment: Tensor
    maps: ShadowMaps | None
    grid: Occupancy
    occlusion: float
