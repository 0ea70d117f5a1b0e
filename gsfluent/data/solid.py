"""A filled object: splats plus the voxel volume they enclose."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsfluent.data._fields import TensorContainer, shape
from gsfluent.data.frame import Frame
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError


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
        return _trilinear(self.depth[..., None], (points - self.origin.to(points)) / self.voxel)[
            :, 0
        ]

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

    def save(self, path: str | Path) -> None:
        """Write the splats to ``path`` (.ply) and the volume to ``<name>.volume.npz`` beside it."""
        import numpy as np

        from gsfluent.io.atomic import atomic_path

        path = Path(path)
        arrays: dict[str, Any] = {
            "occupancy": np.packbits(self.occupancy.cpu().numpy()),
            "shape": np.array(self.occupancy.shape, dtype=np.int64),
            "depth": self.depth.cpu().numpy(),
            "origin": self.origin.cpu().numpy(),
            "voxel": np.float64(self.voxel),
            "report": np.array(json.dumps(self.report)),
            "frame": np.array(json.dumps(None if self.frame is None else self.frame.to_dict())),
        }
        if self.color is not None:
            arrays["color"] = self.color.cpu().numpy()
        if self.regions is not None:
            arrays["regions"] = self.regions.cpu().numpy()
        self.gaussians.save(path)
        with atomic_path(volume_path(path)) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, **arrays)

    @staticmethod
    def load(path: str | Path) -> Solid:
        """Read what :meth:`save` wrote.

        Raises:
            InputError: The splats or the volume are missing or damaged.
        """
        import zipfile

        import numpy as np

        from gsfluent.io.splats import load_splats

        path = Path(path)
        gaussians = load_splats(path)
        beside = volume_path(path)
        if not beside.is_file():
            raise InputError(
                f"{path}: a solid needs {beside.name} beside it, got none",
                "make both with `gsfluent fill`",
            )
        try:
            with np.load(beside, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
            size = tuple(int(count) for count in arrays["shape"])
            bits = np.unpackbits(arrays["occupancy"], count=math.prod(size))
            frame = json.loads(str(arrays["frame"]))
            if gaussians.labels is None:
                gaussians = gaussians.replace(
                    labels=torch.zeros(gaussians.count, dtype=torch.int32)
                )
            return Solid(
                gaussians,
                torch.from_numpy(bits.reshape(size).astype(bool)),
                torch.from_numpy(arrays["depth"]),
                torch.from_numpy(arrays["origin"]),
                float(arrays["voxel"]),
                torch.from_numpy(arrays["color"]) if "color" in arrays else None,
                torch.from_numpy(arrays["regions"]) if "regions" in arrays else None,
                json.loads(str(arrays["report"])),
                None if frame is None else Frame.from_dict(frame),
            )
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(
                f"{beside}: the volume file is damaged ({error})",
                "make it again with `gsfluent fill`",
            ) from error


def volume_path(path: str | Path) -> Path:
    """Name of the volume file that belongs to a solid ``.ply``."""
    return Path(path).with_suffix(".volume.npz")


def _trilinear(grid: Tensor, position: Tensor) -> Tensor:
    """Sample a grid [X, Y, Z, C], voxel centres at +0.5, at grid positions [N, 3]; 0 outside."""
    size = torch.tensor(grid.shape[:3], device=position.device)
    base = (position - 0.5).floor()
    fraction = position - 0.5 - base
    total = grid.new_zeros(position.shape[0], grid.shape[3])
    for corner in range(8):
        offset = torch.tensor(
            [corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=position.device
        )
        index = base.to(torch.int64) + offset
        inside = ((index >= 0) & (index < size)).all(dim=1)
        weight = torch.where(offset.bool(), fraction, 1 - fraction).prod(dim=1) * inside
        index = torch.minimum(index.clamp_min(0), size - 1)
        total += weight.to(grid)[:, None] * grid[index[:, 0], index[:, 1], index[:, 2]]
    return total
