"""A filled object: splats plus the voxel volume they enclose."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data._fields import TensorContainer, shape
from gsfluent.data.frame import Frame
from gsfluent.data.gaussians import Gaussians


@dataclasses.dataclass(frozen=True, eq=False)
class Solid(TensorContainer):
    """Splats with labels and the voxels inside them, all in the world frame of the input.

    The centre of voxel (i, j, k) is ``origin + (i + 0.5, j + 0.5, k + 0.5) * voxel``. The grid
    stays axis-aligned in its own frame for good: moving the solid only changes ``frame`` (world ->
    scene), which consumers apply.

    Args:
        gaussians: Surface and interior splats, labels set.
        occupancy: Voxels that hold matter, bool [X, Y, Z].
        depth: Distance below the surface [world units], float [X, Y, Z]; 0 outside.
        origin: Corner of voxel (0, 0, 0) [3], world units.
        voxel: Edge length of a voxel, world units, positive.
        color: Colour of the matter in 0..1, float [X, Y, Z, 3], or None before texturing.
        regions: Part numbers, int32 [X, Y, Z], or None.
        report: What the stages measured, JSON values.
        frame: World to scene metres, or None while undecided.
    """

    gaussians: Gaussians
    occupancy: Annotated[Tensor, shape("X", "Y", "Z", kind="bool")]
    depth: Annotated[Tensor, shape("X", "Y", "Z", unit="length")]
    origin: Annotated[Tensor, shape(3, unit="length")]
    voxel: float
    color: Annotated[Tensor, shape("X", "Y", "Z", 3)] | None = None
    regions: Annotated[Tensor, shape("X", "Y", "Z", kind="int")] | None = None
    report: dict[str, Any] = dataclasses.field(default_factory=dict)
    frame: Frame | None = None

    def __post_init__(self) -> None:
        """Check shapes and the voxel size."""
        super().__post_init__()
        if not (math.isfinite(self.voxel) and self.voxel > 0):
            raise ValueError(f"Solid: voxel must be positive, got {self.voxel}")
        if self.gaussians.labels is None:
            raise ValueError("Solid: gaussians must carry labels (SURFACE, INTERIOR), got none")

    @property
    def volume(self) -> float:
        """Volume of the matter in cubic world units."""
        return int(self.occupancy.sum()) * self.voxel**3

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Solid:
        """Return a copy on ``device``, splats included."""
        moved = super().to(device, dtype)
        return moved.replace(gaussians=self.gaussians.to(device, dtype))

    def voxel_centers(self, index: Tensor | None = None) -> Tensor:
        """Return centres [M, 3] of voxels ``index`` [M, 3] (default: the occupied), world units."""
        if index is None:
            index = self.occupancy.nonzero()
        return self.origin + (index.to(self.origin) + 0.5) * self.voxel

    def voxel_index(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Find the voxels of world points [N, 3]: (index [N, 3], inside the grid bool [N])."""
        size = torch.tensor(self.occupancy.shape, device=points.device)
        index = ((points - self.origin.to(points)) / self.voxel).floor().to(torch.int64)
        inside = ((index >= 0) & (index < size)).all(dim=1)
        return torch.minimum(index.clamp_min(0), size - 1), inside

    def contains(self, points: Tensor) -> Tensor:
        """Tell which world points [N, 3] lie in an occupied voxel, bool [N]."""
        index, inside = self.voxel_index(points)
        return inside & self.occupancy[index[:, 0], index[:, 1], index[:, 2]]

    def depth_at(self, points: Tensor) -> Tensor:
        """Depth below the surface [N] at world points [N, 3], trilinear; 0 off the grid."""
        place = (points - self.origin.to(points)) / self.voxel - 0.5
        return geometry.trilinear(self.depth, place)

    def color_at(self, points: Tensor) -> Tensor:
        """Colour [N, 3] of the voxel that holds each world point [N, 3]; nearest off the grid.

        Raises:
            ValueError: The solid has no colours yet.
        """
        if self.color is None:
            raise ValueError(
                "Solid.color_at: the solid has no colours; run the texture stage first"
            )
        index, _ = self.voxel_index(points)
        return self.color[index[:, 0], index[:, 1], index[:, 2]]

    def transformed(self, frame: Frame) -> Solid:
        """Return the solid placed by ``frame`` after its present frame; tensors stay."""
        return self.replace(frame=frame if self.frame is None else frame.compose(self.frame))
