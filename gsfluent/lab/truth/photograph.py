"""Photographs of triangle meshes whose inside is known: a z-buffer in torch, on any device.

Pixels are tested at their centres (no widening of outlines), several per pixel and axis, and
averaged. The light stands still while the camera moves, as on a table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.data import Camera

_TILE = 8  # pixels; a triangle is tested in the tiles of its box
_PAIRS = 100_000  # tiles at a time
_AMBIENT = 0.45
_LIGHT = (0.4, 0.75, 0.55)


@dataclass(frozen=True)
class Mesh:
    """Triangles to be photographed."""

    corners: Tensor  # float32 [F, 3, 3]
    normals: Tensor  # unit normals at the corners, float32 [F, 3, 3]
    # colour of surface points: (points [N, 3], face [N], weights [N, 3]) to [N, 3] in 0..1
    color: Callable[[Tensor, Tensor, Tensor], Tensor]


def textured(image: Tensor, uv: Tensor) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Colour from a texture [H, W, 3] and coordinates per corner [F, 3, 2], v upwards."""
    planes = image.permute(2, 0, 1)[None]

    def color(points: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        place = (uv[face] * weights[..., None]).sum(1) % 1.0
        place = torch.stack([2.0 * place[:, 0] - 1.0, 1.0 - 2.0 * place[:, 1]], -1)
        found = functional.grid_sample(
            planes, place[None, None], padding_mode="border", align_corners=False
        )
        return found[0, :, 0].T

    return color


def marbled(
    extent: float, *, device: torch.device | str = "cpu"
) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """A solid colour with detail at many sizes, from sums of waves: something to learn from."""
    source = torch.Generator().manual_seed(0)
    waves = []
    for octave in range(4):
        way = functional.normalize(torch.randn(6, 3, generator=source), dim=1)
        length = (4.0 * 2.0**octave) * 2.0 * math.pi / extent
        phase = 2.0 * math.pi * torch.rand(6, generator=source)
        weight = torch.randn(6, 3, generator=source) * 0.8**octave
        waves.append((way * length, phase, weight))
    parts = [(a.to(device), b.to(device), c.to(device)) for a, b, c in waves]

    def color(points: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        total = sum(torch.sin(points @ way.T + phase) @ weight for way, phase, weight in parts)
        assert isinstance(total, Tensor)
        return torch.sigmoid(0.6 * total)

    return color


def around(mesh: Mesh, count: int, size: int) -> list[Camera]:
    """Cameras on a Fibonacci sphere around a mesh, which fills their pictures [size, size]."""
    points = mesh.corners.reshape(-1, 3).double().cpu()
    low, high = points.amin(0), points.amax(0)
    middle = 0.5 * (low + high)
    radius = float((points - middle).norm(dim=1).max())
    far = 1.03 * radius / math.sin(math.radians(0.5 * 35.0))
    cameras = []
    for index in range(count):
        y = 1.0 - (2.0 * index + 1.0) / count
        angle = index * math.pi * (3.0 - math.sqrt(5.0))
        ring = math.sqrt(1.0 - y * y)
        away = torch.tensor([ring * math.cos(angle), y, ring * math.sin(angle)]).double()
        up = (0.0, 1.0, 0.0) if abs(y) < 0.95 else (1.0, 0.0, 0.0)
        cameras.append(
            Camera.look_at(
                middle + far * away, middle, width=size, height=size, fov=35.0, up=up,
                name=f"{index:03d}.webp",
            )
        )  # fmt: skip
    return cameras


@torch.no_grad()
def visible_faces(corners: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Which triangle each pixel centre sees: face [H, W] (-1 none), weights [H, W, 3], depth.

    Weights are those of the corners in space (perspective-correct). Triangles that reach behind
    the camera are left out.
    """
    device, wide, high = corners.device, camera.width, camera.height
    view, K = camera.viewmat.to(device), camera.K.to(device)
    local = corners.double() @ view[:3, :3].T + view[:3, 3]
    z = local[..., 2]
    pixel = (local @ K.T)[..., :2] / z[..., None].clamp_min(1e-12)
    low, top = pixel.amin(1), pixel.amax(1)
    ahead = (z > 1e-9).all(1) & (top > 0).all(1) & (low[:, 0] < wide) & (low[:, 1] < high)
    kept = ahead.nonzero()[:, 0]
    first = (low[kept] / _TILE).floor().long().clamp_min(0)
    last = (top[kept] / _TILE).floor().long()
    last = torch.minimum(last, last.new_tensor([(wide - 1) // _TILE, (high - 1) // _TILE]))
    across = (last - first + 1).clamp_min(0)
    tiles = across.prod(1)
    owner = torch.repeat_interleave(torch.arange(len(kept), device=device), tiles)
    start = torch.repeat_interleave(tiles.cumsum(0) - tiles, tiles)
    nth = torch.arange(len(owner), device=device) - start
    tile = torch.stack([nth % across[owner, 0], nth // across[owner, 0]], 1) + first[owner]
    grid = torch.arange(_TILE, device=device)
    inner = torch.stack(torch.meshgrid(grid, grid, indexing="xy"), -1).reshape(-1, 2)
    buffer = torch.full((high * wide,), torch.iinfo(torch.int64).max, device=device)
    for at in range(0, len(owner), _PAIRS):
        face = kept[owner[at : at + _PAIRS]]
        spot = tile[at : at + _PAIRS, None] * _TILE + inner
        weight, depth = _weights(pixel[face], z[face], spot.double() + 0.5)
        hit = (weight >= 0).all(-1) & (spot[..., 0] < wide) & (spot[..., 1] < high)
        place = spot[..., 1] * wide + spot[..., 0]
        key = depth.float().view(torch.int32).long() << 32 | face[:, None]
        buffer.scatter_reduce_(0, place[hit], key[hit], "amin")
    seen = buffer != torch.iinfo(torch.int64).max
    face = torch.where(seen, buffer & 0xFFFFFFFF, -1)
    y, x = torch.meshgrid(
        torch.arange(high, device=device), torch.arange(wide, device=device), indexing="ij"
    )
    center = torch.stack([x, y], -1).reshape(-1, 1, 2).double() + 0.5
    known = face.clamp_min(0)
    weight, depth = _weights(pixel[known], z[known], center)
    shape = (high, wide)
    return (
        face.reshape(shape),
        torch.where(seen[:, None], weight[:, 0], 0.0).float().reshape(*shape, 3),
        torch.where(seen, depth[:, 0], 0.0).float().reshape(shape),
    )


def _weights(pixel: Tensor, z: Tensor, spot: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [T, P, 3] of triangles' corners in space at pixels [T, P, 2], and depths [T, P]."""
    a, b, c = pixel[:, None].unbind(2)
    area = _cross(b - a, c - a)
    flat = area.abs() < 1e-12
    screen = torch.stack([_cross(b - spot, c - spot), _cross(c - spot, a - spot)], -1)
    screen = screen / torch.where(flat, torch.ones_like(area), area)[..., None]
    screen = torch.cat([screen, 1.0 - screen.sum(-1, keepdim=True)], -1)
    share = screen / z[:, None]
    depth = 1.0 / share.sum(-1).clamp_min(1e-12)
    weight = share * depth[..., None]
    return torch.where(flat[..., None], torch.full_like(weight, -1.0), weight), depth


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@torch.no_grad()
def photograph(mesh: Mesh, camera: Camera) -> Tensor:
    """One photograph with Lambert shading, RGBA float32 [H, W, 4], straight alpha."""
    supersample = 3
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    face, weight, _ = visible_faces(mesh.corners, fine)
    seen = (face >= 0).flatten()
    known, share = face.flatten()[seen], weight.reshape(-1, 3)[seen]
    points = (mesh.corners[known] * share[..., None]).sum(1)
    normal = functional.normalize((mesh.normals[known] * share[..., None]).sum(1), dim=1)
    eye = fine.center().to(points)
    normal = torch.where(((eye - points) * normal).sum(1, keepdim=True) < 0, -normal, normal)
    light = functional.normalize(points.new_tensor(_LIGHT), dim=0)
    shade = _AMBIENT + (1.0 - _AMBIENT) * (0.5 + 0.5 * normal @ light)
    picture = points.new_zeros(len(seen), 4)
    picture[seen, :3] = mesh.color(points, known, share).clamp(0.0, 1.0) * shade[:, None]
    picture[seen, 3] = 1.0
    planes = picture.reshape(fine.height, fine.width, 4).permute(2, 0, 1)[None]
    mean = functional.avg_pool2d(planes, supersample)[0].permute(1, 2, 0)
    cover = mean[..., 3:]
    return torch.cat([mean[..., :3] / cover.clamp_min(1e-6), cover], -1)
