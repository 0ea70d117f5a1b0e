"""What a shell of splats encloses: density, ray vote and masks together, before any depths.

This closes whatever is surrounded by surface; what cameras look into is taken out again in
:mod:`gsfluent.pipeline.solid.splats`.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsfluent.data import Capture
from gsfluent.errors import InputError
from gsfluent.pipeline.capture.hull import Ground, centre_hull
from gsfluent.pipeline.capture.orient import orient
from gsfluent.pipeline.solid.evidence import FEW, Evidence, SolidOptions
from gsfluent.pipeline.solid.inside import (
    cast_votes,
    keep_components,
    smooth_boundary,
    trim_outer_flank,
)
from gsfluent.spatial.density import GridBox, density_field
from gsfluent.spatial.voxels import distance_transform

_log = logging.getLogger(__name__)

_MASK_SIZE = 400  # pixels
_BURIED = 3.5  # voxels below the closed surface


@dataclass(frozen=True)
class Closed:
    """Result of :func:`vote_solid`; voxels bool [X, Y, Z]."""

    box: GridBox  # the grid
    shell: np.ndarray  # where the density is that of a surface
    loose: np.ndarray  # shell and everything that it encloses
    solid: np.ndarray  # the same with the outer flank of the shell peeled off
    hull: np.ndarray | None  # what the masks allow, or None without masks
    notes: dict[str, Any]  # what was noticed


def vote_solid(known: Evidence, options: SolidOptions) -> Closed:
    """Close a shell of splats; what masks show to be free is cut out of it.

    Raises:
        InputError: Too few splats, none reaches the density of a surface, or the masks do not
            belong to the splats.
    """
    from scipy import ndimage

    gaussians, capture = known.splats, known.capture
    if gaussians.count < FEW:
        raise InputError(
            f"fill: needs at least {FEW} Gaussians, got {gaussians.count}",
            hint="check that isolation kept the object",
        )
    box, strays = known.grid
    field = density_field(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, box
    )
    density = field.cpu().numpy()
    shell = density >= options.threshold
    if not shell.any():
        raise InputError(
            f"fill: no voxel reaches density {options.threshold:g} (largest {density.max():.3g})",
            hint="lower threshold or resolution: the splats are transparent or sparse",
        )
    down = options.down
    if down is None and capture is not None:
        down = -np.asarray(orient(gaussians, capture).up, dtype=float)
    vote = cast_votes(
        shell,
        rays=options.rays,
        down=down,
        close_open_side=options.close_underside,
        device=gaussians.device,
    )
    loose = (vote.score >= options.agreement) | shell
    hull = None
    views = masked_views(capture) if options.masks else []
    if views:
        hull = centre_hull(box, views, gaussians.device)
        # masks say what is not the object; rays cap the cone under objects seen only from above
        # (just outside a convex surface about half of the rays hit it)
        loose = hull & (shell | (vote.score >= 0.65))
        if not loose.any():
            raise InputError(
                "fill: masks and splats do not overlap",
                hint="check that masks are white on the object and belong to these cameras",
            )
    loose, dropped = keep_components(loose)
    loose = ndimage.binary_fill_holes(loose)
    trimmed = trim_outer_flank(loose, shell, density, gaussians.device)
    solid, more = keep_components(smooth_boundary(trimmed))
    # splats well below the surface hint at a cavity or an inner wall
    deep = shell & (distance_transform(loose, gaussians.device) > _BURIED)
    if vote.open_side is not None:
        _log.info(
            "fill: nothing seen from side [%+.2f, %+.2f, %+.2f]; closed there "
            "(%.0f %% of inner voxels look out)",
            *vote.open_side,
            100 * vote.open_fraction,
        )
    notes = {
        "closed_by": "vote" if hull is None else "hull and vote",
        "closed_side": None if vote.open_side is None else list(vote.open_side),
        "closed_side_open_fraction": vote.open_fraction,
        "components_dropped": dropped + more,
        "buried_surface_fraction": float(deep.sum() / max(int(shell.sum()), 1)),
        "stray_gaussians": strays,
    }
    return Closed(box, shell, loose, solid, hull, notes)


def masked_views(capture: Capture | None) -> list[Ground]:
    """Background pixels and undistorted cameras of the views that have a mask."""
    from scipy import ndimage

    if capture is None:
        return []
    views = []
    for view in capture.views(range(len(capture)), _MASK_SIZE):
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
