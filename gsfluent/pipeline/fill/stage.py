"""Fill: a shell of splats becomes a solid with an inside."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gsfluent.data import SURFACE, Capture, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.pipeline.fill.interior import Matter, populate
from gsfluent.pipeline.fill.refine import refine_opacity
from gsfluent.pipeline.fill.skin import skin_gaussians, unseen_skin
from gsfluent.pipeline.fill.support import Support
from gsfluent.pipeline.solid.evidence import Evidence, SolidOptions
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.hollow import cavity_volume
from gsfluent.pipeline.solid.source import find_solid
from gsfluent.pipeline.solid.walls import walls
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress
from gsfluent.spatial.voxels import nearest_empty

if TYPE_CHECKING:
    import trimesh

    Source = SignedDistance | trimesh.Trimesh | str | Path


logger = logging.getLogger(__name__)

_METHODS = ("auto", "vote", "density", "hull", "tsdf")


class Fill(Stage):
    """Decide what is inside a splat cloud and put Gaussians there.

    Steps: what is matter (:func:`gsfluent.pipeline.find_solid`: splats and their depths, masks, or
    a mesh); distance transform; interior Gaussians as fine as the skin's splats where they meet
    it; with a capture, removal of those that the photographs contradict.

    Args:
        resolution: Voxels along the longest side of the object.
        method: Where the inside comes from (docs/theory/solid.md): ``auto``; ``vote`` (rays among
        the
            splats), ``hull`` (the same cut by the masks; masks alone without splats), ``density``
            (``hull`` where there are masks, else ``vote``) or ``tsdf`` (depths alone).
        hollow: ``auto`` (cavities that depths show stay empty; nothing is guessed of closed ones),
            ``none`` (solid through, a cup as well), or the wall thickness in world units.
        threshold: Density above which a voxel belongs to the surface shell (a lone opaque splat has
            1 at its centre).
        agreement: Fraction of rays that must hit the surface.
        rays: 6 or 26 ray directions.
        spacing: Distance between interior Gaussians in voxels; None picks 1.25, wider when more
            than ``max_interior`` Gaussians would be needed.
        max_interior: Upper bound on the number of interior Gaussians.
        down: Downward direction in world coordinates; None asks the capture, and without one finds
            an unseen side by itself.
        close_underside: Close the side that no photograph shows, at its rim.
        match_masks: Move the skin to the outline of the masks, where there are any.
        finer: Take smaller voxels where the walls found are thinner than five of them.
        refine_views: Photographs asked about the interior (0 asks none).
        refine_image_size: Longest image side then [pixels].
        seed: Seed of lattice jitter and view order.

    Raises:
        InputError: An argument is out of range or names an unknown method.
    """

    name = "fill"

    def __init__(
        self,
        resolution: int = 96,
        method: str = "auto",
        hollow: str | float = "auto",
        *,
        threshold: float = 0.5,
        agreement: float = 0.7,
        rays: int = 26,
        spacing: float | None = None,
        max_interior: int = 200_000,
        down: tuple[float, float, float] | None = None,
        close_underside: bool = True,
        match_masks: bool = True,
        finer: bool = True,
        refine_views: int = 24,
        refine_image_size: int = 200,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        wide = spacing is None or 0.5 <= spacing <= 16
        for name, value, fine, must, hint in (
            ("resolution", resolution, 8 <= int(resolution) <= 512, "in 8..512 voxels",
             "96 to 160 is usual"),
            ("method", repr(method), method in _METHODS, f"one of {', '.join(_METHODS)}",
             "leave it at auto"),
            ("rays", rays, rays in (6, 26), "6 or 26", "26 keeps crevices open"),
            ("threshold", threshold, threshold > 0, "> 0", "0.5 is usual"),
            ("agreement", agreement, 0.5 <= agreement <= 1.0, "in 0.5..1", "0.7 is usual"),
            ("spacing", spacing, wide, "in 0.5..16 voxels", "leave it out"),
        ):  # fmt: skip
            if not fine:
                raise InputError(f"fill: {name} must be {must}, got {value}", hint=hint)
        self.resolution = int(resolution)
        self.method = method
        self.hollow = _parse_hollow(hollow)
        self.solid_through = hollow == "none"
        self.options = SolidOptions(
            float(threshold),
            float(agreement),
            rays,
            None if down is None else np.asarray(down, dtype=float),
            close_underside,
            masks=method != "vote",
            match_masks=match_masks,
            match_drawn=False,
            finer=finer,
        )
        self.spacing = spacing
        self.max_interior = int(max_interior)
        self.refine_views = int(refine_views)
        self.refine_image_size = int(refine_image_size)

    def forward(
        self,
        gaussians: Gaussians | None = None,
        capture: Capture | None = None,
        progress: Progress | None = None,
        *,
        solid: Source | None = None,
    ) -> Solid:
        """Fill an object.

        Args:
            gaussians: Splats of one object (isolated from its background). None: the skin gets
                splats in the colours of the photographs, or grey ones.
            capture: The photographs it came from: their cameras tell what is hollow, their masks
                where the skin is, and the opacity fit looks at them.
            progress: Optional callback ``(done, total, note)``.
            solid: What is matter, when that is known better: a
                :class:`~gsfluent.pipeline.solid.field.SignedDistance`, a mesh of trimesh, or a
                mesh file, in the frame of the splats.

        Returns:
            The solid; ``report`` holds ``method`` and ``why``, ``interior_gaussians``, ``volume``
            and ``cavity_volume`` (world units cubed), ``leaks`` and ``leak_list`` (centre and
            area of each), ``below_support`` (share that was cut off below the plane on which the
            object stood), ``closed_side``, ``wall`` (median and 5 % thickness), ``hollow``,
            ``hollow_fraction``, ``unusable_gaussians`` (degenerate, left out) and ``seconds``.

        Raises:
            InputError: Values are not finite, or no inside was found.
        """
        began = time.perf_counter()
        known = support = None
        if gaussians is not None:
            if solid is None:
                support = Support.of(gaussians, capture, self.options.down)
            gaussians = gaussians if support is None else support.above(gaussians)
            known = Evidence.of(gaussians, capture, self.resolution)
            gaussians = known.splats.validated("fill")
        total = 5
        report_progress(progress, 0, total, "inside")
        field = self._inside(known, capture, solid)
        field = field if support is None else support.cut(field)
        report_progress(progress, 2, total, "depth")
        if gaussians is None:
            gaussians = skin_gaussians(field, capture)
        device = gaussians.means.device
        matter, hollow = self._matter(field, device)
        occupied, depth, _, box = matter
        if float(depth.max()) < 1.5 * box.voxel:
            # of walls too thin to break the simulation tells, in its own cells
            logger.info("fill: nothing but thin parts at this resolution")
        report_progress(progress, 3, total, "interior Gaussians")
        merged, inner, placed = populate(
            gaussians.labelled(SURFACE),
            matter,
            spacing=self.spacing,
            max_interior=self.max_interior,
            seed=self.seed,
        )
        refined: dict[str, Any] = {}
        if capture is not None and self.refine_views > 0 and bool(inner.any()):
            merged, inner, refined = refine_opacity(
                merged,
                inner,
                capture,
                views=self.refine_views,
                image_size=self.refine_image_size,
                progress=progress,
            )
        side = field.report.get("closed_side")
        if side is not None:
            under = unseen_skin(field, merged, side)
            merged = Gaussians.cat([merged, under])
            inner = torch.cat([inner, inner.new_zeros(under.count)])
        report_progress(progress, total, total, "filled")
        report = {
            "interior_gaussians": int(inner.sum()),
            "pruned": refined.pop("pruned", 0),
            "method": field.source,
            **field.report,
            "volume": float(occupied.sum() * box.voxel**3),
            "cavity_volume": cavity_volume(occupied, box.voxel),
            "wall": walls(
                field
                if self.hollow is None
                else SignedDistance.of_voxels(occupied, np.array(box.origin), box.voxel, "hollow")
            ),
            "unusable_gaussians": 0 if known is None else known.unusable,
            "hollow_fraction": hollow,
            "grid": list(box.shape),
            "voxel": box.voxel,
            **placed,
            **refined,
            "seconds": time.perf_counter() - began,
        }
        logger.info(
            "fill: %d interior Gaussians, volume %.4g, %d leaks",
            report["interior_gaussians"],
            report["volume"],
            report.get("leaks", 0),
        )
        return Solid(
            gaussians=merged,
            occupancy=torch.from_numpy(occupied).to(device),
            depth=torch.from_numpy(depth).to(device),
            origin=torch.tensor(box.origin, dtype=torch.float32, device=device),
            voxel=box.voxel,
            color=None,
            regions=None,
            report=report,
        )

    def _inside(
        self, known: Evidence | None, capture: Capture | None, solid: Source | None
    ) -> SignedDistance:
        """Decide what is matter, and put nothing there."""
        if isinstance(solid, SignedDistance):
            if not bool(solid.inside.any()):
                raise InputError("fill: nothing is inside the solid that was given", "check it")
            return solid
        if self.method == "hull" and not (capture is not None and capture.shows_masks()):
            raise InputError(
                "fill: method 'hull' needs a capture with masks",
                hint="add masks or use method: vote",
            )
        method = {"vote": "density"}.get(self.method, self.method)
        if known is not None and (method == "hull" or self.solid_through):
            method = "density"
        if solid is not None:
            method = "mesh"
        return find_solid(
            known, capture, solid, method=method, resolution=self.resolution, options=self.options
        )

    def _matter(self, field: SignedDistance, device: torch.device) -> tuple[Matter, float]:
        """Voxels to fill, hollowed if asked, and the share that hollowing took."""
        solid, voxel = field.inside.cpu().numpy(), field.voxel
        # the grid has a rim of empty voxels, so every solid voxel has an outer one
        distance, nearest = nearest_empty(solid, device)
        # voxel centres are half a voxel from the boundary that the transform measures to
        depth = np.where(solid, (distance - 0.5) * voxel, 0.0).astype(np.float32)
        if self.hollow is None:
            return Matter(solid, depth, nearest, field.box), 0.0
        if self.hollow < voxel:
            raise InputError(
                f"fill: hollow wall {self.hollow:g} is thinner than a voxel ({voxel:g})",
                hint="use a thicker wall or a higher resolution",
            )
        wall = solid & (depth <= self.hollow)
        removed = 1.0 - float(wall.sum()) / max(int(solid.sum()), 1)
        depth = np.where(wall, depth, 0.0).astype(np.float32)
        return Matter(wall, depth, nearest, field.box), removed


def _parse_hollow(hollow: str | float) -> float | None:
    """None for solid, else the wall thickness in world units."""
    if isinstance(hollow, str):
        if hollow in ("auto", "none"):
            return None
        try:
            hollow = float(hollow)
        except ValueError:
            raise InputError(
                f"fill: hollow must be auto, none or a wall thickness, got {hollow!r}",
                hint="for a 4 mm wall of an object in metres write hollow: 0.004",
            ) from None
    if not (np.isfinite(hollow) and hollow > 0):
        raise InputError(
            f"fill: hollow wall thickness must be positive, got {hollow}", hint="use hollow: none"
        )
    return float(hollow)


VOXELS_PER_CELL = 2.0
"""Measured (docs/measured/interior.md): from two on, the mass that sampled points bring to the
cells of a
curved surface is limited by the points themselves (3 % of a cell), not by the voxels."""


_PICTURE = 96
"""Voxels along the largest object that its cut faces want, however coarse the simulation is."""


_LEAST, _MOST = 32, 512


def visible_extent(gaussians: Gaussians) -> float:
    """Longest side [world units] of the box of all but the outermost percent of the splats."""
    if gaussians.count == 0:
        return 0.0
    points = gaussians.means.detach().double().T.contiguous().sort(dim=1).values
    margin = gaussians.count // 200
    return float((points[:, gaussians.count - 1 - margin] - points[:, margin]).amax())


def fill_resolution(extent: float, largest: float, cells: int) -> int:
    """Voxels along the longest side of an object.

    All objects of a scene share one grid, so they share one size of voxels: that of the largest
    object, whose longest side the simulation divides into ``cells``.

    Args:
        extent: Longest side of the object.
        largest: Longest side of the largest object of the scene, same unit.
        cells: Grid cells along the largest object.
    """
    whole = max(_PICTURE, math.ceil(VOXELS_PER_CELL * cells))
    share = 1.0 if not largest > 0 else min(1.0, extent / largest)
    return max(_LEAST, min(_MOST, math.ceil(whole * share)))
