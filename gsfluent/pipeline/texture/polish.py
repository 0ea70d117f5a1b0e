"""Colours of coarse interior Gaussians fitted to the slices of a volume."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .domain import InteriorDomain
from .fusion import Steps, fuse_colors, stack_planes

__all__ = ["polish_colors"]

_COARSE = 1.15  # voxels; Gaussians closer than this show the volume already when sampled


def polish_colors(
    domain: InteriorDomain,
    rgb: np.ndarray,
    means: np.ndarray,
    colors: np.ndarray,
    *,
    iterations: int = 4,
    device: torch.device | None = None,
) -> tuple[np.ndarray, dict[str, Any]]:
    """Fit colours so that cuts through the Gaussians show the slices of the volume.

    Sampling a volume at the centres is the better start the finer the Gaussians are. Where they
    are coarser than voxels, what lies between the centres is lost that way; here the slices of all
    three axes, one per spacing, are the targets of a least-squares fit (:func:`.fuse_colors`).

    Args:
        domain: The region.
        rgb: Its colours, float32 [X, Y, Z, 3].
        means: Centres of the Gaussians in voxel units [N, 3].
        colors: Sampled colours [N, 3], kept where no slice shows a Gaussian.
        iterations: Conjugate-gradient steps.
        device: Where to compute.

    Returns:
        Colours [N, 3], and the report: spacing [voxels], polished (False: they are fine enough,
        and nothing was done), and the figures of :func:`.fuse_colors`.
    """
    where = torch.device("cpu") if device is None else device
    spacing = float(domain.inside.sum() / max(len(means), 1)) ** (1.0 / 3.0)
    if len(means) < 8 or spacing < _COARSE:
        return colors, {"polished": False, "spacing": spacing}
    # the skin's own splats show in the outermost voxels
    matter = domain.inside & ~domain.shell
    step = max(1, round(spacing))
    planes, targets, masks = [], [], []
    for axis in range(3):
        filled = np.flatnonzero(matter.any(tuple(i for i in range(3) if i != axis)))
        if len(filled) == 0:
            continue
        index = range(int(filled[0]), int(filled[-1]) + 1, step)
        planes += stack_planes(axis, index, matter.shape, torch.zeros(3, device=where), 1.0)
        targets += [torch.from_numpy(np.take(rgb, k, axis)) for k in index]
        masks += [torch.from_numpy(np.take(matter, k, axis)) for k in index]
    if not planes:
        return colors, {"polished": False, "spacing": spacing}
    fitted, report = fuse_colors(
        torch.from_numpy(means).to(where, torch.float32),
        planes,
        targets,
        spacing=spacing,
        masks=masks,
        initial=torch.from_numpy(colors),
        steps=Steps(iterations),
        slab=0.5 * step,
    )
    return fitted.cpu().numpy(), {"polished": True, "spacing": spacing, **report}
