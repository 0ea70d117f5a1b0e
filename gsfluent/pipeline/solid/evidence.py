"""What is known of an object before its solid is decided: splats, cameras and the grid."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gsfluent.data import Camera, Capture, Gaussians
from gsfluent.pipeline.solid.tsdf import SIZE, ring_of_cameras, zoomed
from gsfluent.spatial.density import GridBox, choose_grid
from gsfluent.spatial.shape import robust_box

FEW = 16  # splats
MOST_CAMERAS = 48  # evenly chosen; more say the same again
_FAINT = 0.05  # opacity below which a splat is no matter
_HUGE = 0.5  # of the object's longest side: a standard deviation above it is no surface
_SAMPLE = 100_000


@dataclass(frozen=True)
class SolidOptions:
    """How the solid of splats is decided.

    Attributes:
        threshold: Density above which a voxel belongs to the shell.
        agreement: Fraction of rays that must hit it.
        rays: 6 or 26 ray directions.
        down: Downward direction [3]; None asks the capture, or finds an unseen side by itself.
        close_underside: Close the side that no photograph shows.
        masks: Cut by the masks, where there are any.
        match_masks: Move the skin of splats to the outline that masks show.
        match_drawn: Without masks, half of the way to the outline of the drawn splats: right for
            trained ones, whose centres lie too deep, too far for large discs.
        finer: Take smaller voxels where the walls found are thinner than five of them.
    """

    threshold: float = 0.5
    agreement: float = 0.7
    rays: int = 26
    down: np.ndarray | None = None
    close_underside: bool = True
    masks: bool = True
    match_masks: bool = True
    match_drawn: bool = True
    finer: bool = True


@dataclass(frozen=True)
class Evidence:
    """What the solid of splats is decided from, gathered once."""

    splats: Gaussians  # those that can be part of a surface
    unusable: int  # how many of the visible ones cannot
    capture: Capture | None  # their photographs, or None
    resolution: int  # voxels along the longest side of the object

    @staticmethod
    def of(gaussians: Gaussians, capture: Capture | None, resolution: int) -> Evidence:
        """Gather it from splats without those that cannot be part of a surface.

        None without a size or a direction, none with a standard deviation above half of the object:
        a single one would hide the object from every camera and blow up every box.
        """
        scales = gaussians.scales
        finite = torch.isfinite(gaussians.means).all(1) & torch.isfinite(scales).all(1)
        finite &= torch.isfinite(gaussians.quats).all(1)
        fine = (scales > 0).all(1) & (gaussians.quats.norm(dim=1) > 1e-12)
        seen = gaussians.opacities > _FAINT
        if int((fine & seen & finite).sum()) >= FEW:
            # quantiles of a hundred thousand points are those of all
            points = gaussians.means[fine & seen & finite].detach()
            low, high = robust_box(points[:: max(1, len(points) // _SAMPLE)].double().cpu().numpy())
            fine &= scales.amax(1) <= _HUGE * float((high - low).max())
        fine |= ~finite  # for validation to name
        unusable = int((seen & ~fine).sum())
        return Evidence(gaussians.select(fine), unusable, capture, resolution)

    @property
    def device(self) -> torch.device:
        """Device of the splats."""
        return self.splats.device

    @functools.cached_property
    def visible(self) -> Gaussians:
        """Splats that are matter."""
        return self.splats.select(self.splats.opacities > _FAINT)

    @functools.cached_property
    def grid(self) -> tuple[GridBox, int]:
        """The grid, and how many visible splats lie outside it."""
        return choose_grid(self.splats.means, self.splats.opacities, self.resolution)

    @property
    def box(self) -> GridBox:
        """The grid."""
        return self.grid[0]

    @functools.cached_property
    def masked(self) -> bool:
        """Whether photographs say where the object is."""
        return self.capture is not None and self.capture.shows_masks()

    def cameras(
        self,
        box: GridBox,
        open_side: Sequence[float] | None,
        size: int = SIZE,
        most: int = MOST_CAMERAS,
    ) -> tuple[list[Camera], bool]:
        """Cameras of the capture cut to a grid, else a ring of cameras around it.

        No camera of the ring looks from an open side: it would see the inside of the far skin.

        Args:
            box: What they shall hold.
            open_side: Direction of a side that nobody saw [3], or None.
            size: Longer side of their pictures [pixels].
            most: Cameras of the capture that are taken.

        Returns:
            The cameras, and whether they are those of the ring.
        """
        low, extent = torch.tensor(box.origin), torch.tensor(box.shape) * box.voxel
        center, radius = low + 0.5 * extent, 0.5 * float(extent.norm())
        if self.capture is not None:
            given = self.capture.cameras
            step = max(1.0, len(given) / most)
            chosen = [given[int(i * step)] for i in range(min(most, len(given)))]
            near = [zoomed(camera, center, radius, size) for camera in chosen]
            cameras = [camera for camera in near if camera is not None]
            if cameras:
                return cameras, False
        cameras = ring_of_cameras(center, radius, size=size)
        if open_side is not None:
            side = torch.tensor(open_side, dtype=torch.float64)
            cameras = [c for c in cameras if float(c.forward() @ side) > -0.1]
        return cameras, True
