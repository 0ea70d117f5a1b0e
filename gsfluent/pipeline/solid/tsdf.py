"""Depth fusion: signed distances from depths that the rasterizer draws (Curless and Levoy 1996).

Every camera says of every point in its picture: free (light passes it), near the surface (how far
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
from gsfluent.draw import draw
from gsfluent.spatial.density import GridBox

_TRUNCATION = 2.0  # voxels
_OPAQUE = 0.5  # opacity from which a ray is stopped
_FREE_SHARE = 0.04  # of the cameras that look: fewer saw through a gap, not past the object
_FREE_LEAST = 2  # cameras
_EDGE = 0.15  # cosine between ray and surface below which a depth is not used
SIZE = 256  # pixels of the drawn pictures
_VIRTUAL = 48  # cameras around an object that brings none
_CHUNK = 1 << 18  # points at a time: their values stay in the caches of a CPU


@dataclass(frozen=True)
class Fused:
    """What cameras say about points; arrays of the shape of the points or the grid."""

    values: np.ndarray  # truncated signed distance [voxels], negative inside
    near: np.ndarray  # cameras that saw a surface there
    known: np.ndarray  # cameras that saw it, free or near the surface

    def on_grid(self, chosen: np.ndarray, free: float) -> Fused:
        """Values of points on the grid that they were chosen from, bool [X, Y, Z].

        The others are seen by nobody and have the distance ``free``.
        """
        grids = []
        for column, rest in ((self.values, free), (self.near, 0.0), (self.known, 0.0)):
            grid = np.full(chosen.shape, rest, dtype=np.float32)
            grid[chosen] = column
            grids.append(grid)
        return Fused(*grids)


@dataclass(frozen=True)
class DepthView:
    """Depths as one camera sees them, [H, W] each."""

    camera: Camera  # the camera
    depth: Tensor  # median depth [world units]
    slant: Tensor  # cosine between ray and surface
    state: Tensor  # 2 where the ray is stopped, 1 next to such a pixel, 0 where light passes


@torch.no_grad()
def depth_views(gaussians: Gaussians, cameras: Sequence[Camera]) -> list[DepthView]:
    """Draw the depths of splats in pinhole cameras."""
    flat = torch.zeros_like(gaussians.means[:, :1])
    views = []
    for camera in cameras:
        result = draw(gaussians, camera, colors=flat, median_depth=True)
        depth, alpha = result.median_depth, result.alpha
        assert depth is not None  # asked for
        grown = torch.nn.functional.max_pool2d(alpha[None, None], 3, 1, 1)[0, 0]
        # next to an outline nobody knows
        state = (grown > _OPAQUE).to(torch.uint8) + (alpha > _OPAQUE).to(torch.uint8)
        views.append(DepthView(camera, depth, _slant(depth, camera), state))
    return views


@torch.no_grad()
def fuse(
    points: Tensor, views: Sequence[DepthView], voxel: float, limit: float = _TRUNCATION
) -> Fused:
    """Fuse depths at points [M, 3].

    Args:
        points: World positions.
        views: What cameras see.
        voxel: Edge of a voxel [world units].
        limit: Distance [voxels] at which distances are cut off; farther before a surface is free.
    """
    parts = [_fuse_part(part, views, voxel, limit * voxel) for part in points.split(_CHUNK)]
    columns = [torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)]
    return Fused(*columns)


def _fuse_part(
    points: Tensor, views: Sequence[DepthView], voxel: float, limit: float
) -> tuple[Tensor, ...]:
    zero = points.new_zeros(len(points))
    total, weight, near = zero, zero.clone(), zero.clone()
    free, hidden = zero.clone(), zero.clone()
    for view in views:
        camera = view.camera
        pose = camera.viewmat.to(points)
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = local[:, 2]
        pixel = local @ camera.K.to(points).T
        pixel = pixel[:, :2] / z.clamp_min(1e-9)[:, None]
        column, row = pixel.floor().clamp(-1, 1e6).long().unbind(1)
        on = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        place = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        state = view.state.flatten()[place]
        stopped = on & (state == 2)
        # Along the ray a slanted surface is farther than across it; seen edge-on it says nothing.
        trust = view.slant.flatten()[place]
        gap = (_depth_at(view, pixel, place) - z) * trust
        sharp = stopped & (trust > _EDGE)
        band = sharp & (gap.abs() < limit)
        # Behind a surface the next one may begin: the deeper, the less is known.
        sure = torch.where(band, trust * (1.0 + gap / limit).clamp(0.0, 1.0), 0.0)
        total += sure * gap
        weight += sure
        near += band
        free += (on & (state == 0)) | (sharp & (gap >= limit))
        hidden += stopped & (gap <= -limit)
    looks = near + free + hidden
    # A camera or two that look through a gap in the skin must not hollow the object out.
    carved = free >= (_FREE_SHARE * looks).clamp_min(_FREE_LEAST)
    spent = torch.where(carved, free, 0.0)
    mean = (total + spent * limit) / (weight + spent).clamp_min(1e-6)
    unknown = torch.where(looks > 0, -limit, limit)
    values = torch.where(weight + spent > 0, mean, unknown) / voxel
    return values.float(), near, near + free


def _depth_at(view: DepthView, pixel: Tensor, place: Tensor) -> Tensor:
    """Depth at pixel positions [M, 2]: between pixels of one surface, else that of the pixel."""
    nearest = view.depth.flatten()[place]
    height, width = view.depth.shape
    scale = pixel.new_tensor([2.0 / width, 2.0 / height])
    between = torch.nn.functional.grid_sample(
        view.depth[None, None],
        (pixel * scale - 1.0)[None, None],
        padding_mode="border",
        align_corners=False,
    )[0, 0, 0]
    # on one surface the two differ by less than a pixel's worth of its slope
    focal = float(view.camera.K[0, 0])
    steep = view.slant.flatten()[place].clamp_min(_EDGE)
    alike = (between - nearest).abs() * focal * steep < nearest
    return torch.where(alike, between, nearest)


@torch.no_grad()
def fuse_depths(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    box: GridBox,
    where: np.ndarray | None = None,
) -> Fused:
    """Fuse the depths of a cloud as cameras see it, at the voxel centres of a grid [X, Y, Z].

    Args:
        gaussians: Splats of one object.
        cameras: Where to look from; distortion is left out.
        box: The grid.
        where: Voxels of interest, bool [X, Y, Z]; the others count as free, seen by nobody. All
            when None.
    """
    chosen = np.ones(box.shape, dtype=bool) if where is None else where
    index = np.argwhere(chosen)
    points = torch.from_numpy(box.centers(index)).to(gaussians.means)
    found = fuse(points, depth_views(gaussians, cameras), box.voxel)
    return found.on_grid(chosen, _TRUNCATION)


def ring_of_cameras(
    center: Tensor, radius: float, count: int = _VIRTUAL, size: int = SIZE
) -> list[Camera]:
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
            Camera.look_at(eye, center.double().cpu(), width=size, height=size, fov=30.0, up=up)
        )
    return cameras


def zoomed(camera: Camera, center: Tensor, radius: float, size: int = SIZE) -> Camera | None:
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
    focal = 0.5 * size * math.sqrt(z * z - radius * radius) / radius * 0.95
    intrinsics = [
        [focal, 0.0, 0.5 * size - focal * x],
        [0.0, focal, 0.5 * size - focal * y],
        [0.0, 0.0, 1.0],
    ]
    return Camera(camera.viewmat, torch.tensor(intrinsics, dtype=torch.float64), size, size)


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
