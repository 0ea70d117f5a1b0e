"""The lamps' views: depth and opacity of the splats as each lamp sees them, in one call.

A directional lamp looks through a perspective camera 500 scene radii away (its rays differ by 0.1
degrees from parallel). A point lamp outside the matter has one wide map toward it; one close to or
inside it has the six faces of a cube. Maps move in whole texels and change size in steps, so that
the edges of shadows do not swim when the object moves. Nothing here waits for the device.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import geometry, ops
from gsfluent.data import Gaussians
from gsfluent.pipeline.light import Lamp, Vector
from gsfluent.pipeline.shade import MAP
from gsfluent.pipeline.shade_shadow import ShadowMaps

__all__ = ["bulk", "faces_of", "shadow_maps"]

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
# Bias: what is nearer than this many mean splat sizes, plus texels, is the surface itself.
_BIAS_SPLATS = 1.0
_BIAS_TEXELS = 1.0
# The bulk of the matter: at most this many root-mean-square distances from its mean.
_BULK = 3.0
_NEAR = 1e-4


def bulk(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Centre [3] and radius [] of the matter less what flew far, on the device."""
    means = gaussians.means
    middle = means.mean(0)
    away = (means - middle).square().sum(-1)
    size = 3.0 * gaussians.scales.mean()
    radius = torch.minimum(away.amax().sqrt(), _BULK * away.mean().sqrt()) + size
    return middle, radius.clamp(min=1e-9)


def faces_of(lamps: tuple[Lamp, ...], center: Vector, radius: float) -> tuple[int, ...]:
    """Shadow maps of each lamp: 0, 1, or 6 for a point lamp close to the matter."""
    counts = []
    for lamp in lamps:
        count = 0
        if lamp.shadow:
            close = lamp.position is not None and math.dist(lamp.position, center) < (
                _OUTSIDE * radius
            )
            count = 6 if close else 1
        counts.append(count)
    return tuple(counts)


def shadow_maps(
    gaussians: Gaussians,
    lamps: tuple[Lamp, ...],
    faces: tuple[int, ...],
    size: int,
    *,
    groups: Tensor | None = None,
) -> ShadowMaps | None:
    """Render the maps of all lamps; None when none casts a shadow.

    Args:
        gaussians: What blocks the light.
        lamps: What :meth:`gsfluent.pipeline.light.Lighting.drawn` gives.
        faces: What :func:`faces_of` gives.
        size: Texels along the side of a map.
        groups: Siblings of which only the nearest shades a texel, int32 [N].
    """
    if not any(faces):
        return None
    means = gaussians.means
    middle, radius = bulk(gaussians)
    splat = gaussians.scales.mean()
    views, focals, nearest = [], [], []
    for lamp, count in zip(lamps, faces, strict=True):
        if count == 0:
            continue
        if lamp.position is None:
            view, focal, near = _directional(lamp, middle, radius, size)
        else:
            view, focal, near = _point(lamp.position, count, middle, radius, size)
        views.append(view)
        focals.append(focal.expand(count))
        nearest.append(near.expand(count))
    viewmat, focal, near = torch.cat(views), torch.cat(focals), torch.cat(nearest)
    intrinsics = torch.zeros(focal.shape[0], 3, 3, dtype=means.dtype, device=means.device)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal
    intrinsics[:, :2, 2] = 0.5 * size
    intrinsics[:, 2, 2] = 1.0
    seen = ops.rasterize(
        means,
        gaussians.opacities,
        viewmat,
        intrinsics,
        size,
        size,
        quats=gaussians.quats,
        scales=gaussians.scales,
        colors=means[:, :1],  # not looked at; the rasterizer wants some
        groups=groups,
        near=_NEAR,
    )
    texel = (near + radius) / focal
    bias = _BIAS_SPLATS * splat + _BIAS_TEXELS * texel
    cameras = torch.cat([viewmat[:, :3].flatten(1), torch.stack([focal, near, bias], 1)], 1)
    assert cameras.shape[1] == MAP
    return ShadowMaps(seen.depth, seen.alpha, cameras)


def _directional(
    lamp: Lamp, middle: Tensor, radius: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """View [1, 4, 4], focal length [1] and nearest depth [1] of a directional lamp."""
    turn = _rotation(lamp.toward, middle.dtype, middle.device)
    stepped = torch.exp2((torch.log2(radius) * _STEPS).ceil() / _STEPS)
    texel = stepped * (2.0 * _BORDER / size)
    local = turn @ middle
    local = torch.cat([(local[:2] / texel).round() * texel, local[2:]])
    distance = _FAR * stepped
    shift = torch.cat([-local[:2], distance - local[2:]])
    focal = middle.new_full((1,), 0.5 * size * _FAR / _BORDER)
    return _viewmat(turn, shift)[None], focal, (distance - stepped)[None]


def _point(
    position: Vector, count: int, middle: Tensor, radius: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Views [count, 4, 4], focal length [1] and nearest depth [1] of a point lamp."""
    place = _constant(position, middle.dtype, middle.device)
    away = middle - place
    distance = away.norm()
    near = torch.maximum(distance - radius, 0.05 * radius)[None]
    if count == 6:
        turns = _cube(middle.dtype, middle.device)
        views = torch.stack([_viewmat(turn, -(turn @ place)) for turn in turns])
        return views, middle.new_full((1,), 0.5 * size / _CUBE), near
    forward = away / distance
    up = _constant((0.0, 0.0, 1.0), middle.dtype, middle.device)
    side = _constant((0.0, 1.0, 0.0), middle.dtype, middle.device)
    up = torch.where(forward[2].abs() > 0.95, side, up)
    right = normalize(torch.linalg.cross(forward, up), dim=0)
    turn = torch.stack([right, torch.linalg.cross(forward, right), forward])
    sine = (_BORDER * radius / distance).clamp(max=0.9)
    focal = 0.5 * size * (1.0 - sine * sine).sqrt() / sine
    return _viewmat(turn, -(turn @ place))[None], focal[None], near


def _viewmat(turn: Tensor, shift: Tensor) -> Tensor:
    bottom = torch.zeros_like(turn[:1])
    last = _constant((0.0, 0.0, 0.0, 1.0), turn.dtype, turn.device)
    return torch.cat([torch.cat([turn, bottom]), torch.cat([shift, last[3:]])[:, None]], 1)


@functools.lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).to(device, dtype)


@functools.lru_cache(maxsize=256)
def _rotation(toward: Vector, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Rotation [3, 3] into the camera of a lamp that shines along minus ``toward``."""
    eye = torch.tensor(toward, dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return geometry.look_at(eye, torch.zeros_like(eye), up)[:3, :3].to(device, dtype)


@functools.lru_cache(maxsize=8)
def _cube(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Rotations [6, 3, 3] into the faces of a cube, forward +-x, +-y, +-z."""
    faces = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            toward = [0.0, 0.0, 0.0]
            toward[axis] = -sign
            x, y, z = toward
            faces.append(_rotation((x, y, z), dtype, device))
    return torch.stack(faces)
