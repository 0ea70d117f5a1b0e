"""Grids of the synthesis: fixed in the object, not in the voxel grid that happens to hold it.

A solid that is filled again at another resolution, or whose grid starts elsewhere, has another
voxel grid. The coarse levels of the synthesis therefore live on lattices anchored at the object's
centre of mass with pitches that are fractions of the object's size, and start from noise that is
a hash of lattice coordinates. Only the last level uses the voxels themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.pipeline.texture.volume.domain import InteriorDomain, axis_frame

_COARSEST = 16.0  # voxels per object size (cube root of the volume) at the first level
_SLAB = 1 << 21  # points sampled at once


@dataclass(frozen=True)
class Lattice:
    """A regular grid in the object's frame; lengths in voxels of the solid.

    Attributes:
        corner: Corner of cell (0, 0, 0) in the object's frame, [3].
        pitch: Edge of a cell.
        shape: Number of cells.
        rotation: Rows are the object's axes in the solid's grid, [3, 3].
        center: Origin of the object's frame in the solid's grid, [3].
    """

    corner: tuple[float, float, float]
    pitch: float
    shape: tuple[int, int, int]
    rotation: np.ndarray
    center: np.ndarray

    @property
    def first(self) -> tuple[int, int, int]:
        """Number of cell (0, 0, 0), counted from the object's centre."""
        a, b, c = (round(v / self.pitch) for v in self.corner)
        return a, b, c

    def local(self, device: torch.device) -> list[Tensor]:
        """Coordinates of the cell centres in the object's frame, broadcastable [X, 1, 1] etc."""
        axes = []
        for k in range(3):
            line = self.corner[k] + (torch.arange(self.shape[k], device=device) + 0.5) * self.pitch
            axes.append(line.reshape([-1 if i == k else 1 for i in range(3)]).float())
        return axes

    def sample(self, volume: Tensor) -> Tensor:
        """Values [C, X, Y, Z] of a volume [C, *] on the solid's grid, trilinear, 0 outside."""
        turn = torch.tensor(self.rotation, dtype=torch.float32, device=volume.device)
        center = torch.tensor(self.center, dtype=torch.float32, device=volume.device)
        x, y, z = self.local(volume.device)
        out = volume.new_empty(volume.shape[0], *self.shape)
        rows = max(1, _SLAB // (self.shape[1] * self.shape[2]))
        for start in range(0, self.shape[0], rows):
            part = x[start : start + rows]
            points = (
                part[..., None] * turn[0] + y[..., None] * turn[1] + z[..., None] * turn[2] + center
            )
            out[:, start : start + rows] = trilinear(volume, points)
        return out

    def read(self, volume: Tensor, points: Tensor) -> Tensor:
        """Values [C, ...] of a volume [C, *shape] at points [..., 3] of the solid's grid."""
        turn = torch.tensor(self.rotation, dtype=torch.float32, device=volume.device)
        center = torch.tensor(self.center, dtype=torch.float32, device=volume.device)
        corner = torch.tensor(self.corner, dtype=torch.float32, device=volume.device)
        local = ((points - center) @ turn.T - corner) / self.pitch
        return trilinear(volume, local)


def trilinear(volume: Tensor, points: Tensor) -> Tensor:
    """Values [C, ...] of a volume [C, X, Y, Z] at points [..., 3] in cells (centres at +0.5)."""
    size = torch.tensor(volume.shape[1:], dtype=torch.float32, device=volume.device)
    grid = (2.0 * points / size - 1.0).flip(-1).reshape(1, 1, 1, -1, 3)
    values = functional.grid_sample(volume[None], grid, mode="bilinear", align_corners=False)
    return values.reshape(volume.shape[0], *points.shape[:-1])


class ObjectFields:
    """What is known about the object, on its own voxel grid, on one device.

    Args:
        domain: The solid's voxels.
        aligned: Keep the voxel grid's directions (materials without direction). Otherwise the
            object's frame has its z axis along ``domain.axis``.
        device: Where to compute.
    """

    def __init__(self, domain: InteriorDomain, aligned: bool, device: torch.device) -> None:
        self.device = device
        self.inside = torch.from_numpy(domain.inside).to(device)
        share = self.inside.float()
        depth = torch.from_numpy(domain.depth).to(device).float()
        shell = torch.from_numpy(domain.shell).to(device).float()
        skin = torch.from_numpy(domain.skin).to(device).float().movedim(-1, 0)
        self.fields = torch.cat([share[None], depth[None] * share, shell[None], skin * shell])
        self.max_depth = domain.max_depth
        count = float(domain.inside.sum())
        self.size = count ** (1.0 / 3.0)
        self.rotation = np.eye(3) if aligned else axis_frame(np.asarray(domain.axis, float))
        middle = []
        for k in range(3):
            line = domain.inside.sum(tuple(i for i in range(3) if i != k))
            middle.append(float((line * (np.arange(len(line)) + 0.5)).sum() / count))
        self.center = np.array(middle)
        # what the solid spans in the object's frame
        corners = torch.nonzero(self.inside).float().add_(0.5).cpu().numpy()
        local = (corners - self.center) @ self.rotation.T
        self.low, self.high = local.min(0) - 0.5, local.max(0) + 0.5

    def lattices(self) -> list[Lattice]:
        """Lattices coarse to fine; the last one has the pitch of the solid's grid."""
        on_grid = bool(np.abs(np.abs(self.rotation).max(1) - 1.0).max() < 1e-6)
        pitches = []
        pitch = self.size / _COARSEST
        while pitch >= 1.5:
            # a solid thinner than three cells has no inside at that level
            if 2.0 * self.max_depth >= 3.0 * pitch:
                pitches.append(pitch)
            pitch /= 2.0
        found = []
        for pitch in pitches:
            first, last = np.floor(self.low / pitch) - 1, np.ceil(self.high / pitch) + 1
            found.append(self._lattice(first * pitch, pitch, last - first))
        # cells of the solid's own grid; of the same size where the object's axis is oblique
        span = self.high - self.low
        return [*found, self._lattice(self.low, 1.0, np.rint(span) if on_grid else np.ceil(span))]

    def _lattice(self, corner: np.ndarray, pitch: float, count: np.ndarray) -> Lattice:
        a, b, c = (float(v) for v in corner)
        x, y, z = (int(v) for v in count)
        return Lattice((a, b, c), float(pitch), (x, y, z), self.rotation, self.center)

    def on(self, lattice: Lattice) -> dict[str, Tensor]:
        """Fields on a lattice.

        Returns:
            ``inside`` and ``shell`` bool [X, Y, Z], ``depth`` [voxels of the solid] [X, Y, Z] and
            ``skin`` RGB [3, X, Y, Z] (defined in the shell).
        """
        factor = max(1, int(lattice.pitch))
        fields = self.fields
        if factor > 1:
            extra = [(-s) % factor for s in fields.shape[1:]]
            fields = functional.pad(fields, (0, extra[2], 0, extra[1], 0, extra[0]))
            fields = functional.avg_pool3d(fields[None], factor)[0]
            scaled = Lattice(
                tuple(v / factor for v in lattice.corner),  # type: ignore[arg-type]
                lattice.pitch / factor,
                lattice.shape,
                lattice.rotation,
                lattice.center / factor,
            )
        else:
            scaled = lattice
        sampled = scaled.sample(fields)
        share = sampled[0]
        inside = share > 0.5
        depth = torch.where(inside, sampled[1] / share.clamp(min=1e-3), torch.zeros_like(share))
        near = depth <= max(lattice.pitch, 1.6 if lattice.pitch <= 1.0 else 0.0)
        shell = inside & (sampled[2] > 0.05) & near
        skin = sampled[3:] / sampled[2].clamp(min=1e-3)
        return {"inside": inside, "depth": depth, "shell": shell, "skin": skin.clamp(0, 1)}


def hashed_noise(lattice: Lattice, channels: int, seed: int, device: torch.device) -> Tensor:
    """White normal noise [C, X, Y, Z] that depends on the cell's place in the object only."""
    lines = [
        torch.arange(n, device=device) + f
        for n, f in zip(lattice.shape, lattice.first, strict=True)
    ]
    x, y, z = torch.meshgrid(*lines, indexing="ij")
    out = torch.empty((channels, *lattice.shape), device=device)
    for c in range(channels):
        salt = seed * 2 * channels + 2 * c
        first, second = ((hashed(x, y, z, salt + k).double() + 0.5) / 2.0**32 for k in range(2))
        # Box and Muller 1958
        out[c] = ((-2.0 * first.log()).sqrt() * (2.0 * torch.pi * second).cos()).float()
    return out


def hashed(x: Tensor, y: Tensor, z: Tensor, salt: int) -> Tensor:
    """Well mixed number below 2^32 (int64) for each integer place."""
    mask = 0xFFFFFFFF
    h = (x * 0x8DA6B343) ^ (y * 0xD8163841) ^ (z * 0xCB1AB31F)
    h = (h ^ (salt * 0x9E3779B1 & mask)) & mask
    for shift, factor in ((16, 0x7FEB352D), (15, 0x6CA68B49), (16, 0x31848BAB)):
        h = ((h ^ (h >> shift)) * factor) & mask
    return h ^ (h >> 16)


def nearest_inside(inside: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Cells outside within ``reach`` steps and, for each, a cell inside close by (flat indices)."""
    size = inside.numel()
    unknown = size
    index = torch.where(
        inside, torch.arange(size, device=inside.device).reshape(inside.shape), unknown
    )
    for _ in range(reach):
        grown = index
        for axis in range(3):
            for step in (1, -1):
                moved = torch.roll(index, step, axis)
                edge = [slice(None)] * 3
                edge[axis] = slice(0, 1) if step == 1 else slice(-1, None)
                moved[tuple(edge)] = unknown
                grown = torch.where((grown == unknown) & (moved != unknown), moved, grown)
        index = grown
    found = (index != unknown) & ~inside
    return found.reshape(-1).nonzero()[:, 0], index[found]


def pad_edges(volume: Tensor, inside: Tensor, reach: int) -> Tensor:
    """A volume [C, X, Y, Z] whose cells just outside repeat a near cell inside."""
    target, source = nearest_inside(inside, reach)
    flat = volume.reshape(volume.shape[0], -1).clone()
    flat[:, target] = flat[:, source]
    return flat.reshape(volume.shape)
