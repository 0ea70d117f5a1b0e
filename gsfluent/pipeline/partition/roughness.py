"""Roughness of crack faces below the scale of the grid: a displacement hashed from the rest place.

Crack faces are self-affine: the height over a distance r goes as ``r^0.8``, on metals, glass, rock
and ceramics alike (Bouchaud 1997). Both sides of a crack ask for the same place and get the same
displacement, so that faces fit. Values lie on lattices of the voxels of the partition, one for each
octave, and are interpolated by smoothsteps along one axis after the other: one operation at a time,
so that every device rounds alike.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

HURST = 0.8
"""Exponent of the structure function, from 2 to 12 voxels (four point spacings)."""
SPACINGS = (48.0, 24.0, 12.0, 6.0, 3.0, 1.5)
"""Lattices of the octaves, in voxels. Longer ones than 12 carry the law up to there."""
_WEIGHT = 0.97  # exponent of the octaves that gives 0.8: a finite band of them is flatter
_FAMILIES = {
    "fruit": 0.25, "bread": 0.4, "foam": 0.4, "snow": 0.4, "glass": 0.03, "ice": 0.03,
}  # fmt: skip
_OTHERS = 0.15
_SLAB = (1 << 17, 1 << 22)  # voxels at a time, on the CPU and elsewhere
_UNIFORM = 3.0**-0.5  # rms of what is uniform in -1 to 1
# mean of the square of a smoothstep blend of independent values, three axes
_BLEND = (2.0 * 13.0 / 35.0) ** 1.5


def amplitude(material: str) -> float:
    """Rms height of crack faces of a material, in point spacings, by the family of its preset.

    Args:
        material: Name of the preset; what stands before its first dot is the family.
    """
    return _FAMILIES.get(material.split(".")[0], _OTHERS)


def displacement(low: tuple[int, int, int], shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Unit displacements at the voxels of a box.

    Args:
        low: Index of the first voxel.
        shape: Voxels along each axis.
        device: Where.

    Returns:
        Vectors [3, X, Y, Z], each component with an rms of 1.
    """
    total = torch.zeros((3, *shape), device=device)
    weights = [spacing**_WEIGHT for spacing in SPACINGS]
    norm = sum(w * w for w in weights) ** 0.5 * _UNIFORM * _BLEND
    for octave, (spacing, weight) in enumerate(zip(SPACINGS, weights, strict=True)):
        total = total + _octave(low, shape, spacing, octave, device) * (weight / norm)
    return total


def displacements(voxels: Tensor, low: tuple[int, int, int], shape: tuple[int, ...]) -> Tensor:
    """:func:`displacement` at some voxels of a box.

    Args:
        voxels: Of the box, int64 [M, 3], in ascending order of the first index.
        low: Index of the box's first voxel.
        shape: Voxels of the box along each axis.

    Returns:
        Vectors [M, 3].
    """
    at_once = _SLAB[voxels.device.type != "cpu"]
    thick = max(1, at_once // max(1, shape[1] * shape[2]))
    starts = torch.arange(0, shape[0] + thick, thick, device=voxels.device)
    bounds = torch.searchsorted(voxels[:, 0].contiguous(), starts).tolist()
    parts = [voxels.new_zeros((0, 3), dtype=torch.float32)]
    for number, (a, b) in enumerate(itertools.pairwise(bounds)):
        if a == b:
            continue
        first = number * thick
        size = (min(thick, shape[0] - first), *shape[1:])
        slab = displacement((low[0] + first, low[1], low[2]), size, voxels.device)
        x, y, z = voxels[a:b].unbind(dim=1)
        parts.append(slab[:, x - first, y, z].T)
    return torch.cat(parts)


def _octave(
    low: tuple[int, int, int], shape: tuple[int, ...], spacing: float, octave: int,
    device: torch.device,
) -> Tensor:  # fmt: skip
    axes, cells, shares = [], [], []
    for first, count in zip(low, shape, strict=True):
        place = (torch.arange(count, device=device, dtype=torch.float64) + first) / spacing
        # lattices of different octaves have no plane in common
        place = place + 0.37 * (octave + 1)
        base = place.floor()
        t = (place - base).to(torch.float32)
        start = int(base[0])
        axes.append(torch.arange(start, int(base[-1]) + 2, device=device))
        cells.append(base.long() - start)
        shares.append(t * t * (3.0 - 2.0 * t))
    value = _hashed(axes, octave)
    for axis in range(3):
        view = [1, 1, 1, 1]
        view[axis + 1] = -1
        t = shares[axis].view(view)
        near = value.index_select(axis + 1, cells[axis])
        far = value.index_select(axis + 1, cells[axis] + 1)
        value = near + t * (far - near)
    return value


_MASK = 0xFFFFFFFF


def _hashed(axes: list[Tensor], octave: int) -> Tensor:
    """Three uniform values in -1 to 1 at each node of a lattice, [3, X, Y, Z]."""
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    h = ((x * 0x8DA6B343) & _MASK) ^ ((y * 0xD8163841) & _MASK) ^ ((z * 0xCB1AB31F) & _MASK)
    h = h ^ ((octave * 0x9E3779B1 + 0x2545F491) & _MASK)
    parts = []
    for turn in (0x7FEB352D, 0x846CA68B, 0x9E3779B1):
        h = ((h ^ (h >> 16)) * turn) & _MASK
        h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & _MASK
        parts.append((h ^ (h >> 16)).to(torch.float64) * (2.0 / 4294967296.0) - 1.0)
    return torch.stack(parts).to(torch.float32)
