"""The object's solid as a grid of signed distances: negative inside, zero on the surface.

``inside`` is what the Fracture-GS notes call SDF <= 0. Where the distances come from is in
:mod:`gsfluent.pipeline.solid.source`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Solid
from gsfluent.ops.spatial import trilinear
from gsfluent.spatial.density import GridBox
from gsfluent.spatial.voxels import distance_transform

_RIM = 3  # empty voxels around the object, so that every surface closes inside the grid
_SMOOTH = 1.0  # voxels; takes the steps off a surface that is known by whole voxels
_MOST = 0.35  # voxels; more than half a step, less than would eat a wall two voxels thick
_LEAST = 0.05  # voxels; smoothing moves no voxel to the other side of the surface


@dataclasses.dataclass(frozen=True, eq=False)
class SignedDistance:
    """Signed distances to the surface of one solid.

    The centre of voxel (i, j, k) is ``origin + (i + 0.5, j + 0.5, k + 0.5) * voxel``, in the world
    frame of the input. The rim of the grid is outside everywhere.

    Attributes:
        values: Distances at the voxel centres [world units], negative inside, float32 [X, Y, Z].
        origin: Corner of voxel (0, 0, 0), [3].
        voxel: Edge of a voxel [world units].
        source: ``hull``, ``density``, ``tsdf``, ``mesh`` or ``solid``.
        report: What was noticed: ``why``, ``leaks``, ``seconds`` and notes of the source.
    """

    values: Tensor
    origin: Tensor
    voxel: float
    source: str
    report: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the shapes and the voxel size."""
        if self.values.dim() != 3 or tuple(self.origin.shape) != (3,):
            got = f"{list(self.values.shape)} and {list(self.origin.shape)}"
            raise ValueError(f"SignedDistance: values [X, Y, Z] and origin [3], got {got}")
        if not (math.isfinite(self.voxel) and self.voxel > 0):
            raise ValueError(f"SignedDistance: voxel must be positive, got {self.voxel}")

    @property
    def inside(self) -> Tensor:
        """Voxels whose centre is inside, bool [X, Y, Z]."""
        return self.values <= 0

    @property
    def box(self) -> GridBox:
        """The grid of the values."""
        return GridBox.of(self.origin, float(self.voxel), self.values.shape)

    @property
    def volume(self) -> float:
        """Volume [cubic world units]; voxels at the surface count by the share that is inside."""
        share = (0.5 - self.values.double() / self.voxel).clamp(0.0, 1.0)
        return float(share.sum()) * self.voxel**3

    def at(self, points: Tensor) -> Tensor:
        """Signed distances [N] at world points [N, 3], trilinear.

        Off the grid: the distance to the grid is added to the value at its border, a bound from
        above.
        """
        size = torch.tensor(self.values.shape, device=self.values.device)
        place = (points.to(self.values) - self.origin.to(self.values)) / self.voxel - 0.5
        held = torch.minimum(place.clamp_min(0.0), (size - 1).to(place))
        return trilinear(self.values, held) + (place - held).norm(dim=1) * self.voxel

    def to(self, device: torch.device | str) -> SignedDistance:
        """Return a copy whose values live on ``device``."""
        return self.replace(values=self.values.to(device), origin=self.origin.to(device))

    def replace(self, **changes: Any) -> SignedDistance:
        """Return a copy with the named fields replaced."""
        return dataclasses.replace(self, **changes)

    def tidied(self, share: float = 0.01) -> SignedDistance:
        """Without crumbs (less than ``share`` of the largest body) and enclosed bubbles.

        Bodies are joined by faces, as the surface is. For sources that guess: nobody saw a bubble.
        """
        from scipy import ndimage

        inside = self.inside.cpu().numpy()
        label, count = ndimage.label(inside)
        sizes = np.bincount(label.ravel(), minlength=count + 1)
        sizes[0] = 0
        kept = (sizes >= max(1.0, share * sizes.max()))[label]
        full = torch.from_numpy(ndimage.binary_fill_holes(kept)).to(self.values.device)
        least = _LEAST * self.voxel
        size = self.values.abs().clamp_min(least)
        changed = full != self.inside
        return self.replace(
            values=torch.where(changed, torch.where(full, -size, size), self.values)
        )

    @staticmethod
    def of_voxels(
        occupancy: np.ndarray,
        origin: np.ndarray,
        voxel: float,
        source: str,
        report: dict[str, Any] | None = None,
        *,
        device: torch.device | None = None,
    ) -> SignedDistance:
        """Distances to the boundary of whole voxels, bool [X, Y, Z], padded to an empty rim."""
        solid, start = _padded(np.asarray(occupancy, dtype=bool), np.asarray(origin), voxel)
        values = torch.from_numpy(distances_of(solid, device=device) * np.float32(voxel))
        field = SignedDistance(
            values, torch.from_numpy(start).float(), float(voxel), source, dict(report or {})
        )
        return field if device is None else field.to(device)

    @staticmethod
    def of_solid(solid: Solid) -> SignedDistance:
        """Distances to the boundary of a filled object."""
        kept = ("leaks", "leaking_voxels", "closed_side", "method")
        notes = {name: solid.report[name] for name in kept if name in solid.report}
        return SignedDistance.of_voxels(
            solid.occupancy.cpu().numpy(),
            solid.origin.double().cpu().numpy(),
            solid.voxel,
            "solid",
            notes,
        )


def distances_of(
    occupancy: np.ndarray, *, smooth: float = _SMOOTH, device: torch.device | None = None
) -> np.ndarray:
    """Signed distance [voxels] to the boundary of voxels bool [X, Y, Z], float32.

    ``EDT(outside) - EDT(inside)``, each less the half voxel from a centre to the boundary, blurred
    by ``smooth`` voxels but moved by no more than 0.35, and shifted to the volume it had (a blur
    shrinks what is round). No voxel changes sides: ``(result <= 0) == occupancy``. ``device`` says
    where the transforms are computed.
    """
    from scipy import ndimage

    solid = np.asarray(occupancy, dtype=bool)
    if not solid.any() or solid.all():
        return np.full(solid.shape, -math.inf if solid.any() else math.inf, dtype=np.float32)
    outer = np.maximum(distance_transform(~solid, device) - 0.5, 0.0)
    inner = np.maximum(distance_transform(solid, device) - 0.5, 0.0)
    signed = np.where(solid, -inner, outer).astype(np.float32)
    if smooth > 0:
        blurred = ndimage.gaussian_filter(signed, smooth, mode="nearest")
        signed = np.clip(blurred, signed - _MOST, signed + _MOST)
        signed += _level(signed, float(solid.sum()))
    return np.where(solid, np.minimum(signed, -_LEAST), np.maximum(signed, _LEAST))


def _level(signed: np.ndarray, volume: float) -> np.float32:
    """Shift [voxels] that gives a field this volume [voxels], by bisection."""
    near = signed[np.abs(signed) < 1.5]
    full = float((signed <= -1.5).sum())
    low, high = -0.5, 0.5
    for _ in range(12):
        middle = 0.5 * (low + high)
        if full + float(np.clip(0.5 - (near + middle), 0.0, 1.0).sum()) > volume:
            low = middle
        else:
            high = middle
    return np.float32(0.5 * (low + high))


def _padded(
    occupancy: np.ndarray, origin: np.ndarray, voxel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cut or pad the grid so that exactly :data:`_RIM` empty voxels surround what is occupied."""
    where = np.argwhere(occupancy)
    if len(where) == 0:
        return occupancy, origin.astype(np.float64)
    low, high = where.min(axis=0), where.max(axis=0) + 1
    tight = occupancy[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    return np.pad(tight, _RIM), origin + (low - _RIM) * voxel
