"""The lamps' views: depth and opacity of the splats as each lamp sees them, in one call.

A directional lamp looks through a perspective camera 500 scene radii away (its rays differ by 0.1
degrees from parallel). A point lamp outside the matter has one wide map toward it; one close to or
inside it has the six faces of a cube. Maps move in whole texels and change size in steps, so that
the edges of shadows do not swim when the object moves. Nothing here waits for the device.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import geometry, ops
from gsfluent.data import Gaussians
from gsfluent.pipeline.light import Lamp, Vector
from gsfluent.pipeline.shade import MAP
from gsfluent.pipeline.shade_shadow import ShadowMaps

__all__ = ["Bulk", "bulk", "faces_of", "shadow_maps"]

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
# Splats that are looked at to find the bulk, and mean splat sizes that are added to its radius.
_SAMPLE = 65_536
_MARGIN = 4.0


class Bulk(NamedTuple):
    """Where the bulk of the matter is.

    Attributes:
        middle: Mean of the centres [m], [3].
        radius: Of a ball around it that holds the bulk [m], [].
        splat: Mean size of a splat [m], [].
    """

    middle: Tensor
    radius: Tensor
    splat: Tensor


def bulk(gaussians: Gaussians) -> Bulk:
    """Where the matter is, less what flew far, from a sample of the splats; on the device."""
    every = max(1, gaussians.count // _SAMPLE)
    means = gaussians.means[::every]
    middle = means.mean(0)
    away = (means - middle).square().sum(-1)
    splat = gaussians.scales[::every].mean()
    radius = torch.minimum(away.amax().sqrt(), _BULK * away.mean().sqrt()) + _MARGIN * splat
    return Bulk(middle, radius.clamp(min=1e-9), splat)


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
    where: Bulk | None = None,
) -> ShadowMaps | None:
    """Render the maps of all lamps; None when none casts a shadow.

    Args:
        gaussians: What blocks the light.
        lamps: What :meth:`gsfluent.pipeline.light.Lighting.drawn` gives.
        faces: What :func:`faces_of` gives.
        size: Texels along the side of a map.
        groups: Siblings of which only the nearest shades a texel, int32 [N].
        where: What :func:`bulk` gives, if it is known.
    """
    if not any(faces):
        return None
    where = bulk(gaussians) if where is None else where
    cameras = _cameras(lamps, faces, size, where)
    # maps of directional lamps stand in one run wherever there are several
    viewmat = torch.cat([part.viewmat for part in cameras]) if cameras[1:] else cameras[0].viewmat
    intrinsics = torch.cat([part.K for part in cameras]) if cameras[1:] else cameras[0].K
    near = torch.cat([part.near for part in cameras]) if cameras[1:] else cameras[0].near
    seen = ops.rasterize(
        gaussians.means,
        gaussians.opacities,
        viewmat,
        intrinsics,
        size,
        size,
        quats=gaussians.quats,
        scales=gaussians.scales,
        colors=gaussians.opacities[:, None],  # not looked at; the rasterizer wants some
        groups=groups,
        near=_NEAR,
    )
    focal = intrinsics[:, 0, :1]
    texel = (near + where.radius)[:, None] / focal
    bias = _BIAS_SPLATS * where.splat + _BIAS_TEXELS * texel
    rows = torch.cat([viewmat[:, :3].flatten(1), focal, near[:, None], bias], 1)
    assert rows.shape[1] == MAP
    return ShadowMaps(seen.depth, seen.alpha, rows)


class _Cameras(NamedTuple):
    """Views [M, 4, 4], intrinsics [M, 3, 3] and nearest depths [M]."""

    viewmat: Tensor
    K: Tensor
    near: Tensor


def _cameras(
    lamps: tuple[Lamp, ...], faces: tuple[int, ...], size: int, where: Bulk
) -> list[_Cameras]:
    """The lamps' cameras in the lamps' order; neighbouring directional ones in one part."""
    parts: list[_Cameras] = []
    run: list[Vector] = []
    for lamp, count in zip(lamps, faces, strict=True):
        if count == 0:
            continue
        if lamp.position is None:
            run.append(lamp.toward)
            continue
        if run:
            parts.append(_directional(tuple(run), size, where))
            run = []
        parts.append(_point(lamp.position, count, where, size))
    if run:
        parts.append(_directional(tuple(run), size, where))
    return parts


def _directional(toward: tuple[Vector, ...], size: int, where: Bulk) -> _Cameras:
    """Cameras of directional lamps: few operations, because each costs as much as a large one."""
    like = where.middle
    frame, intrinsics, ahead = _fixed(toward, size, like.dtype, like.device)
    stepped = torch.exp2((torch.log2(where.radius) * _STEPS).ceil() / _STEPS)
    texel = stepped * (2.0 * _BORDER / size)
    local = frame[:, :3, :3] @ where.middle
    viewmat = frame.clone()
    viewmat[:, :3, 3] = ahead * stepped - (local / texel).round() * texel
    return _Cameras(viewmat, intrinsics, ((_FAR - 1.0) * stepped).expand(len(toward)))


@functools.lru_cache(maxsize=64)
def _fixed(
    toward: tuple[Vector, ...], size: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """What the cameras of directional lamps have whatever the matter does.

    Views without their shift [L, 4, 4], intrinsics [L, 3, 3], and the shift per radius [3].
    """
    views = torch.eye(4, dtype=torch.float64).repeat(len(toward), 1, 1)
    for view, way in zip(views, toward, strict=True):
        view[:3, :3] = _rotation(way, torch.float64, torch.device("cpu"))
    intrinsics = torch.eye(3, dtype=torch.float64).repeat(len(toward), 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = 0.5 * size * _FAR / _BORDER
    intrinsics[:, :2, 2] = 0.5 * size
    ahead = torch.tensor([0.0, 0.0, _FAR], dtype=torch.float64)
    views, intrinsics, ahead = (t.to(device, dtype) for t in (views, intrinsics, ahead))
    return views, intrinsics, ahead


def _point(position: Vector, count: int, where: Bulk, size: int) -> _Cameras:
    """Cameras of a point lamp: one toward the matter, or the faces of a cube."""
    middle, radius = where.middle, where.radius
    place = _constant(position, middle.dtype, middle.device)
    away = middle - place
    distance = away.norm()
    near = torch.maximum(distance - radius, 0.05 * radius).expand(count)
    intrinsics = _centred(size, middle.dtype, middle.device)
    if count == 6:
        turns = _cube(middle.dtype, middle.device)
        views = torch.stack([_viewmat(turn, -(turn @ place)) for turn in turns])
        return _Cameras(views, _scaled(intrinsics, middle.new_full((6,), 0.5 * size / _CUBE)), near)
    forward = away / distance
    up = _constant((0.0, 0.0, 1.0), middle.dtype, middle.device)
    side = _constant((0.0, 1.0, 0.0), middle.dtype, middle.device)
    up = torch.where(forward[2].abs() > 0.95, side, up)
    right = normalize(torch.linalg.cross(forward, up), dim=0)
    turn = torch.stack([right, torch.linalg.cross(forward, right), forward])
    sine = (_BORDER * radius / distance).clamp(max=0.9)
    focal = 0.5 * size * (1.0 - sine * sine).sqrt() / sine
    return _Cameras(_viewmat(turn, -(turn @ place))[None], _scaled(intrinsics, focal[None]), near)


def _scaled(intrinsics: Tensor, focal: Tensor) -> Tensor:
    """Intrinsics [M, 3, 3] with focal lengths [M]."""
    scaled = intrinsics.repeat(focal.shape[0], 1, 1)
    scaled[:, 0, 0] = scaled[:, 1, 1] = focal
    return scaled


@functools.lru_cache(maxsize=16)
def _centred(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Intrinsics [3, 3] of a square map, focal length 1."""
    rows = [[1.0, 0.0, 0.5 * size], [0.0, 1.0, 0.5 * size], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64).to(device, dtype)


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
