"""Fill: a shell of splats becomes a solid with an inside."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.errors import InputError

from .fill_density import GridBox, choose_grid, density_field
from .fill_inside import (
    cast_votes,
    count_leaks,
    keep_components,
    smooth_boundary,
    trim_outer_flank,
    visual_hull,
)
from .fill_interior import (
    _INTERIOR_OPACITY,
    interior_gaussians,
    refine_opacity,
)
from .fill_view import cut_view, surface_colors
from .orient import orient
from .solid_skin import grown_to_masks
from .stage import Progress, Stage, report_progress
from .voxels import distance_transform, nearest_empty

if TYPE_CHECKING:
    from gsfluent.data import Capture, Gaussians, Solid

__all__ = ["Fill", "cut_view"]

logger = logging.getLogger(__name__)

_METHODS = ("auto", "vote", "hull")


class Fill(Stage):
    """Decide what is inside a splat cloud and put Gaussians there.

    Steps: opacity density on a grid (GaussianFluent Eq. 2 with exact covariances); surface voxels
    above ``threshold``; inside by a vote of rays, and by the visual hull where the capture has
    masks; the outer half of the surface shell trimmed; largest component(s); distance transform;
    interior Gaussians on a jittered lattice; with a capture, an opacity-only fit against the
    photographs and pruning of what turned transparent.

    Args:
        resolution: Voxels along the longest side of the object.
        method: ``auto`` (hull and vote when there are masks, else vote), ``vote`` or ``hull``
            (needs masks).
        hollow: ``auto`` (solid; what points to a cavity is reported, nothing is guessed), ``none``
            (solid), or a wall thickness in world units.
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
        match_masks: Grow the solid to the outline of the masks, where there are any.
        refine_iterations: Steps of the opacity fit (0 switches it off).
        refine_image_size: Longest image side in the fit [pixels].
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
        refine_iterations: int = 24,
        refine_image_size: int = 200,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        if not 8 <= int(resolution) <= 512:
            raise InputError(
                f"fill: resolution must be in 8..512 voxels, got {resolution}",
                mend="96 to 160 is usual",
            )
        if method not in _METHODS:
            raise InputError(
                f"fill: method must be one of {', '.join(_METHODS)}, got {method!r}",
                mend="leave it at auto",
            )
        if rays not in (6, 26):
            raise InputError(
                f"fill: rays must be 6 or 26, got {rays}", mend="26 keeps crevices open"
            )
        if not threshold > 0:
            raise InputError(f"fill: threshold must be > 0, got {threshold}", mend="0.5 is usual")
        if not 0.5 <= agreement <= 1.0:
            raise InputError(
                f"fill: agreement must be in 0.5..1, got {agreement}", mend="0.7 is usual"
            )
        if spacing is not None and not 0.5 <= spacing <= 16:
            raise InputError(
                f"fill: spacing must be in 0.5..16 voxels, got {spacing}", mend="leave it out"
            )
        self.resolution = int(resolution)
        self.method = method
        self.hollow = _parse_hollow(hollow)
        self.threshold = float(threshold)
        self.agreement = float(agreement)
        self.rays = rays
        self.spacing = spacing
        self.max_interior = int(max_interior)
        self.down = None if down is None else np.asarray(down, dtype=float)
        self.close_underside = close_underside
        self.match_masks = match_masks
        self.refine_iterations = int(refine_iterations)
        self.refine_image_size = int(refine_image_size)

    def forward(
        self,
        gaussians: Gaussians,
        capture: Capture | None = None,
        progress: Progress | None = None,
    ) -> Solid:
        """Fill a splat object.

        Args:
            gaussians: Splats of one object (isolated from its background).
            capture: The photographs it came from; enables the hull and the opacity fit.
            progress: Optional callback ``(done, total, note)``.

        Returns:
            The solid; ``report`` holds interior_gaussians, volume (world units cubed), leaks,
            hollow_fraction, closed side and seconds.

        Raises:
            InputError: Values are not finite, or no inside was found.
        """
        from gsfluent.data import SURFACE, Solid

        began = time.perf_counter()
        gaussians = gaussians.validated()
        total = 5
        box, solid, report = self.inside(gaussians, capture, progress)
        report_progress(progress, 2, total, "depth")
        solid, depth, nearest, hollow_fraction = self._depth(solid, box.voxel, gaussians.device)
        report_progress(progress, 3, total, "interior Gaussians")
        surface = gaussians.replace(
            labels=torch.full(
                (gaussians.count,), SURFACE, dtype=torch.int32, device=gaussians.means.device
            )
        )
        merged, inner = self._populate(surface, solid, depth, nearest, box)
        refined: dict[str, float] = {}
        pruned = 0
        if capture is not None and self.refine_iterations > 0 and bool(inner.any()):
            opacity, refined = refine_opacity(
                merged,
                inner,
                capture,
                iterations=self.refine_iterations,
                image_size=self.refine_image_size,
                seed=self.seed,
                progress=progress,
            )
            keep = ~inner | (opacity > 0.1)
            pruned = int((~keep).sum())
            merged = merged.replace(opacities=opacity).select(keep)
            inner = inner[keep]
        report_progress(progress, total, total, "filled")
        report = {
            "interior_gaussians": int(inner.sum()),
            "pruned": pruned,
            "volume": float(solid.sum() * box.voxel**3),
            "leaks": report.pop("leaks"),
            "hollow_fraction": hollow_fraction,
            "grid": list(box.shape),
            "voxel": box.voxel,
            **report,
            **refined,
            "seconds": time.perf_counter() - began,
        }
        logger.info(
            "fill: %d interior Gaussians, volume %.4g, %d leaks",
            report["interior_gaussians"],
            report["volume"],
            report["leaks"],
        )
        return Solid(
            gaussians=merged,
            occupancy=torch.from_numpy(solid).to(merged.device),
            depth=torch.from_numpy(depth).to(merged.device),
            origin=torch.tensor(box.origin, dtype=torch.float32, device=merged.device),
            voxel=box.voxel,
            color=None,
            regions=None,
            report=report,
        )

    def inside(
        self,
        gaussians: Gaussians,
        capture: Capture | None = None,
        progress: Progress | None = None,
    ) -> tuple[GridBox, np.ndarray, dict[str, Any]]:
        """Decide which voxels hold matter, and put nothing there.

        Args:
            gaussians: Splats of one object.
            capture: The photographs it came from; enables the hull.
            progress: Optional callback ``(done, total, note)``.

        Returns:
            The grid, the occupied voxels bool [X, Y, Z], and the notes ``method, leaks,
            leaking_voxels, closed_side, closed_side_open_fraction, components_dropped,
            buried_surface_fraction, stray_gaussians``.

        Raises:
            InputError: Too few splats, or none reaches the density of a surface.
        """
        if gaussians.count < 16:
            raise InputError(
                f"fill: needs at least 16 Gaussians, got {gaussians.count}",
                mend="check that isolation kept the object",
            )
        report_progress(progress, 0, 5, "density")
        box, strays = choose_grid(gaussians.means, gaussians.opacities, self.resolution)
        density = (
            density_field(
                gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, box
            )
            .cpu()
            .numpy()
        )
        shell = density >= self.threshold
        if not shell.any():
            raise InputError(
                f"fill: no voxel reaches density {self.threshold:g} (largest {density.max():.3g})",
                mend="lower threshold or resolution: the splats are transparent or sparse",
            )
        report_progress(progress, 1, 5, "inside")
        down = self.down
        if down is None and capture is not None:
            down = -np.asarray(orient(gaussians, capture).up, dtype=float)
        solid, notes = self._decide(box, density, shell, capture, down, gaussians.device)
        return box, solid, notes | {"stray_gaussians": strays}

    def _decide(
        self,
        box: GridBox,
        density: np.ndarray,
        shell: np.ndarray,
        capture: Capture | None,
        down: np.ndarray | None,
        device: torch.device,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Occupied voxels and what was noticed on the way."""
        from scipy import ndimage

        vote = cast_votes(shell, rays=self.rays, down=down, close_open_side=self.close_underside)
        views = _masked_views(capture) if self.method != "vote" else []
        if self.method == "hull" and not views:
            raise InputError(
                "fill: method 'hull' needs a capture with masks",
                mend="add masks or use method: vote",
            )
        inside = vote.score >= self.agreement
        solid = inside | shell
        method = "vote"
        if views:
            hull = visual_hull(box, views, device)
            # masks say what is not the object; rays cap the cone under objects seen only from above
            # (just outside a convex surface about half of the rays hit it)
            solid = hull & (shell | (vote.score >= 0.65))
            method = "hull and vote"
            if not solid.any():
                raise InputError(
                    "fill: masks and splats do not overlap",
                    mend="check that masks are white on the object and belong to these cameras",
                )
        solid, dropped = keep_components(solid)
        solid = ndimage.binary_fill_holes(solid)
        leaks, wet = count_leaks(shell, solid)
        if vote.open_side is not None:
            leaks = max(leaks, 1)
        untrimmed = solid
        solid = smooth_boundary(trim_outer_flank(solid, shell, density, device))
        solid, more = keep_components(solid)
        offset = 0.0
        if self.match_masks and views and capture is not None:
            # what one sees reaches beyond the centres of the splats; the masks say how far
            solid, offset = grown_to_masks(solid, hull, box, capture, device)
        inner = int((solid & ~shell).sum())
        if inner == 0:
            logger.warning(
                "fill: the object is all shell at this resolution: nothing but thin parts"
            )
        # splats well below the surface hint at a cavity or an inner wall
        depth = distance_transform(untrimmed, device)
        buried = float((shell & (depth > 5.0)).sum() / max(int(shell.sum()), 1))
        if vote.open_side is not None:
            logger.info(
                "fill: nothing seen from side %s; closed there (%.0f %% of inner voxels look out)",
                vote.open_side,
                100 * vote.open_fraction,
            )
        notes = {
            "method": method,
            "leaks": leaks,
            "leaking_voxels": wet,
            "closed_side": None if vote.open_side is None else list(vote.open_side),
            "closed_side_open_fraction": vote.open_fraction,
            "components_dropped": dropped + more,
            "buried_surface_fraction": buried,
            "skin_offset": offset,
        }
        return solid, notes

    def _depth(
        self, solid: np.ndarray, voxel: float, device: torch.device
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Hollow the solid if asked; depth in world units and nearest outer voxel [3, X, Y, Z]."""
        # the grid has a rim of empty voxels, so every solid voxel has an outer one
        distance, nearest = nearest_empty(solid, device)
        # voxel centres are half a voxel from the boundary that the transform measures to
        depth = np.where(solid, (distance - 0.5) * voxel, 0.0).astype(np.float32)
        if self.hollow is None:
            return solid, depth, nearest, 0.0
        if self.hollow < voxel:
            raise InputError(
                f"fill: hollow wall {self.hollow:g} is thinner than a voxel ({voxel:g})",
                mend="use a thicker wall or a higher resolution",
            )
        wall = solid & (depth <= self.hollow)
        removed = 1.0 - float(wall.sum()) / max(int(solid.sum()), 1)
        return wall, np.where(wall, depth, 0.0).astype(np.float32), nearest, removed

    def _populate(
        self,
        surface: Gaussians,
        solid: np.ndarray,
        depth: np.ndarray,
        nearest: np.ndarray,
        box: GridBox,
    ) -> tuple[Gaussians, Tensor]:
        """Append interior Gaussians that wear the colour of the surface nearest to them."""
        from gsfluent.data import INTERIOR, Gaussians

        spacing = self.spacing
        if spacing is None:
            spacing = max(1.25, float(solid.sum() / max(self.max_interior, 1)) ** (1 / 3))
        origin = np.asarray(box.origin)
        centers, sigma = interior_gaussians(
            solid, depth, origin, box.voxel, spacing * box.voxel, self.seed
        )
        count = centers.shape[0]
        device, dtype = surface.means.device, surface.dtype
        inner = torch.zeros(surface.count + count, dtype=torch.bool, device=device)
        inner[surface.count :] = True
        if count == 0:
            return surface, inner
        voxel = tuple(np.floor((centers - origin) / box.voxel).astype(int).T)
        skin = np.stack([nearest[i][voxel] for i in range(3)], axis=1)
        # few distinct skin voxels serve many Gaussians; asking the tree from deep inside is slow
        unique, back = np.unique(skin, axis=0, return_inverse=True)
        color = surface_colors(surface, box.centers(unique), box.voxel)[back.reshape(-1)]
        interior = Gaussians.from_colors(
            torch.from_numpy(centers).to(device, dtype),
            torch.full((count,), sigma, dtype=dtype, device=device),
            torch.from_numpy(color).to(device, dtype),
            opacities=_INTERIOR_OPACITY,
            label=INTERIOR,
        )
        return Gaussians.cat([surface.replace(normals=None), interior]), inner


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
                mend="for a 4 mm wall of an object in metres write hollow: 0.004",
            ) from None
    if not (np.isfinite(hollow) and hollow > 0):
        raise InputError(
            f"fill: hollow wall thickness must be positive, got {hollow}", mend="use hollow: none"
        )
    return float(hollow)


def _masked_views(
    capture: Capture | None, size: int = 400
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Background pixels and undistorted cameras of the views that have a mask."""
    from scipy import ndimage

    if capture is None:
        return []
    views = []
    for i in range(len(capture.cameras)):
        view = capture.view(i, max_size=size)
        if view.mask is None:
            continue
        ground = view.mask < 0.5
        if view.valid is not None:
            ground = ground & view.valid
        # one pixel of tolerance: masks and poses are never better than that
        ground_pixels = ndimage.binary_erosion(
            ground.cpu().numpy(), np.ones((3, 3)), border_value=1
        )
        views.append(
            (
                ground_pixels,
                view.camera.viewmat.double().cpu().numpy(),
                view.camera.K.double().cpu().numpy(),
            )
        )
    return views
