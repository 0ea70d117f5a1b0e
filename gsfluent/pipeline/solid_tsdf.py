"""Depth fusion: signed distances from depths that the rasterizer draws (Curless and Levoy 1996).

Every camera says of every voxel in its picture: free (light passes it), near the surface (how far
before or behind), or hidden. What all cameras call hidden is inside. Where the picture is
transparent, everything along the ray is free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.draw import draw
from gsfluent.pipeline.fill_density import GridBox

__all__ = ["Fused", "fuse_depths", "ring_of_cameras", "zoomed"]

_TRUNCATION = 2.0  # voxels
_OPAQUE = 0.5  # opacity from which a ray is stopped
_FREE_SHARE = 0.04  # of the cameras that look: fewer saw through a gap, not past the object
_FREE_LEAST = 2  # cameras
_EDGE = 0.15  # cosine between ray and surface below which a depth is not used
_SIZE = 256  # pixels of the drawn pictures
_VIRTUAL = 48  # cameras around an object that brings none


@dataclass(frozen=True)
class Fused:
    """Result of :func:`fuse_depths`, one value per voxel [X, Y, Z].

    Attributes:
        values: Truncated signed distance [voxels], negative inside.
        looks: Cameras whose picture holds the voxel.
        known: Cameras that saw it, free or near the surface.
    """

    values: np.ndarray
    looks: np.ndarray
    known: np.ndarray


@torch.no_grad()
def fuse_depths(gaussians: Gaussians, cameras: Sequence[Camera], box: GridBox) -> Fused:
    """Fuse the depths of a cloud as cameras see it.

    Args:
        gaussians: Splats of one object.
        cameras: Where to look from; distortion is left out.
        box: The grid.
    """
    device = gaussians.device
    axes = [torch.arange(n, device=device, dtype=torch.float32) + 0.5 for n in box.shape]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = gaussians.means.new_tensor(box.origin) + grid.to(gaussians.means) * box.voxel
    zero = points.new_zeros(len(points))
    total, weight, near = zero, zero.clone(), zero.clone()
    free, hidden = zero.clone(), zero.clone()
    limit = _TRUNCATION * box.voxel
    for camera in cameras:
        depth, alpha = _drawn(gaussians, camera)
        slant = _slant(depth, camera).flatten()
        clear = _clear(alpha).flatten()
        view = camera.viewmat.to(points)
        local = points @ view[:3, :3].T + view[:3, 3]
        z = local[:, 2]
        pixel = local @ camera.K.to(points).T
        pixel = pixel[:, :2] / z.clamp_min(1e-9)[:, None]
        column, row = pixel.floor().clamp(-1, 1e6).long().unbind(1)
        on = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        place = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        stopped = alpha.flatten()[place] > _OPAQUE
        # Along the ray a slanted surface is farther than across it; seen edge-on it says nothing.
        trust = slant[place]
        gap = (depth.flatten()[place] - z) * trust
        through = on & ~stopped & clear[place]
        before = on & stopped & (gap >= limit) & (trust > _EDGE)
        band = on & stopped & (gap.abs() < limit) & (trust > _EDGE)
        # Behind a surface the next one may begin: the deeper, the less is known.
        sure = trust * (1.0 + gap / limit).clamp(0.0, 1.0)
        total += torch.where(band, gap * sure, 0.0)
        weight += torch.where(band, sure, 0.0)
        near += band
        free += through | before
        hidden += on & stopped & (gap <= -limit)
    looks = near + free + hidden
    # A camera or two that look through a gap in the skin must not hollow the object out.
    carved = free >= (_FREE_SHARE * looks).clamp_min(_FREE_LEAST)
    spent = torch.where(carved, free, 0.0)
    mean = (total + spent * limit) / (weight + spent).clamp_min(1e-6)
    unknown = torch.where(looks > 0, -limit, limit)
    values = torch.where(weight + spent > 0, mean, unknown) / box.voxel
    shape = box.shape
    return Fused(
        values.reshape(shape).float().cpu().numpy(),
        looks.reshape(shape).cpu().numpy(),
        (near + free).reshape(shape).cpu().numpy(),
    )


def ring_of_cameras(center: Tensor, radius: float, count: int = _VIRTUAL) -> list[Camera]:
    """Cameras spread evenly over a sphere (Fibonacci spiral) that all see a ball [world units]."""
    cameras = []
    for index in range(count):
        z = 1.0 - (2.0 * index + 1.0) / count
        angle = index * math.pi * (3.0 - math.sqrt(5.0))
        ring = math.sqrt(1.0 - z * z)
        away = torch.tensor([ring * math.cos(angle), ring * math.sin(angle), z]).double()
        up = (0.0, 0.0, 1.0) if abs(z) < 0.95 else (1.0, 0.0, 0.0)
        eye = center.double().cpu() + 4.0 * radius * away
        cameras.append(
            Camera.look_at(eye, center.double().cpu(), width=_SIZE, height=_SIZE, fov=30.0, up=up)
        )
    return cameras


def zoomed(camera: Camera, center: Tensor, radius: float) -> Camera | None:
    """The camera with its picture cut and scaled to a ball; None when it does not see the middle.

    Photographs show an object at any size; what is fused should not depend on that.
    """
    middle = center.double().cpu()
    local = camera.viewmat[:3, :3].double() @ middle + camera.viewmat[:3, 3].double()
    z = float(local[2])
    if z <= 1.05 * radius:
        return None
    x, y = float(local[0]) / z, float(local[1]) / z
    place = camera.K.double() @ torch.tensor([x, y, 1.0], dtype=torch.float64)
    if not (0 <= float(place[0]) < camera.width and 0 <= float(place[1]) < camera.height):
        return None
    focal = 0.5 * _SIZE * math.sqrt(z * z - radius * radius) / radius * 0.95
    intrinsics = [
        [focal, 0.0, 0.5 * _SIZE - focal * x],
        [0.0, focal, 0.5 * _SIZE - focal * y],
        [0.0, 0.0, 1.0],
    ]
    return Camera(camera.viewmat, torch.tensor(intrinsics, dtype=torch.float64), _SIZE, _SIZE)


def _slant(depth: Tensor, camera: Camera) -> Tensor:
    """Cosine between the ray of each pixel and the surface it meets, from depth slopes, [H, W].

    For a depth z(u, v) the normal is along (-f_x z_u, -f_y z_v, z + (u - c_x) z_u + (v - c_y) z_v);
    a jump of depth gives a cosine near zero.
    """
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    height, width = depth.shape
    x = (torch.arange(width, device=depth.device) + 0.5 - float(camera.K[0, 2])) / fx
    y = ((torch.arange(height, device=depth.device) + 0.5 - float(camera.K[1, 2])) / fy)[:, None]
    down, across = torch.gradient(depth)
    along = depth + x * fx * across + y * fy * down
    length = (fx * across).square() + (fy * down).square() + along.square()
    ray = (1.0 + x.square() + y.square()).sqrt()
    # the normal times the ray (x, y, 1) is the depth itself
    return depth / (length.sqrt() * ray).clamp_min(1e-12)


def _clear(alpha: Tensor) -> Tensor:
    """Pixels with nothing opaque in or next to them, bool [H, W]: at an outline nobody knows."""
    grown = torch.nn.functional.max_pool2d(alpha[None, None], 3, 1, 1)[0, 0]
    return grown <= _OPAQUE


def _drawn(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth and opacity as a camera sees them, [H, W] each."""
    flat = torch.zeros_like(gaussians.means[:, :1])
    result = draw(gaussians, camera, colors=flat, median_depth=True)
    assert result.median_depth is not None  # asked for
    return result.median_depth, result.alpha
