"""Points and Gaussians inside a solid: jittered lattices and the opacity-only refinement."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from .stage import Progress, report_progress

if TYPE_CHECKING:
    from gsfluent.data import Capture, Gaussians

__all__ = ["interior_gaussians", "jittered_lattice", "refine_opacity"]

logger = logging.getLogger(__name__)

_SIGMA_PER_SPACING = 0.55  # neighbours overlap at 0.91 sigma: no gaps when the solid is cut open
_INTERIOR_OPACITY = 0.95


def jittered_lattice(
    inside: np.ndarray, spacing: float, *, seed: int, jitter: float = 1.0
) -> np.ndarray:
    """Stratified points: one per cube of edge ``spacing``, uniform inside it, kept where inside.

    Args:
        inside: Voxels, bool [X, Y, Z].
        spacing: Edge of a cube, in voxels.
        seed: Seed of the jitter.
        jitter: 0 puts points on cube centres, 1 anywhere in the cube.

    Returns:
        Positions float64 [M, 3] in voxel units (voxel (i, j, k) spans i..i+1).
    """
    if not spacing > 0:
        raise ValueError(f"jittered_lattice: spacing must be > 0, got {spacing}")
    occupied = np.argwhere(inside)
    if occupied.shape[0] == 0:
        return np.zeros((0, 3))
    low, high = occupied.min(0), occupied.max(0) + 1
    counts = np.maximum(np.ceil((high - low) / spacing).astype(int), 1)
    # the lattice is centred on the box, so a symmetric solid gets a symmetric lattice
    start = 0.5 * (low + high) - 0.5 * counts * spacing
    rng = np.random.default_rng(seed)
    found = []
    for i in range(counts[0]):  # slab by slab: the full lattice of a large solid need not fit
        cell = np.stack(
            np.meshgrid([i], np.arange(counts[1]), np.arange(counts[2]), indexing="ij"), -1
        ).reshape(-1, 3)
        shift = 0.5 + jitter * (rng.random(cell.shape) - 0.5)
        point = start + (cell + shift) * spacing
        voxel = np.floor(point).astype(int)
        valid = ((voxel >= 0) & (voxel < inside.shape)).all(1)
        valid[valid] = inside[tuple(voxel[valid].T)]
        found.append(point[valid])
    return np.concatenate(found)


def interior_gaussians(
    inside: np.ndarray,
    depth: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    spacing: float,
    seed: int,
) -> tuple[np.ndarray, float]:
    """Centres of interior Gaussians: a jittered lattice, two standard deviations below the skin.

    Args:
        inside: Voxels, bool [X, Y, Z].
        depth: Distance below the surface [X, Y, Z], world units.
        origin: Corner of voxel (0, 0, 0), world units.
        voxel: Edge of a voxel, world units.
        spacing: Lattice spacing, world units.
        seed: Seed of the jitter.

    Returns:
        Centres float64 [M, 3] in world units and their common standard deviation.
    """
    sigma = _SIGMA_PER_SPACING * spacing
    # thin parts have no room for two sigma; one and a half voxels still keeps them filled
    deep = inside & (depth > min(2.0 * sigma, 1.5 * voxel))
    point = jittered_lattice(deep, spacing / voxel, seed=seed, jitter=0.6)
    return origin + point * voxel, sigma


def refine_opacity(
    gaussians: Gaussians,
    interior: Tensor,
    capture: Capture,
    *,
    iterations: int,
    image_size: int,
    seed: int,
    progress: Progress | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """Lower the opacity of interior Gaussians that the photographs would show.

    Only the interior opacities move; everything else is frozen. During the fit the interior wears
    the complement of the nearby surface colour, so whatever of it can be seen disagrees with the
    photographs as much as possible.

    Args:
        gaussians: Surface and interior Gaussians.
        interior: Mask bool [N] of the interior ones.
        capture: Posed photographs.
        iterations: Number of single-view steps.
        image_size: Longest side of the images used [pixels].
        seed: Seed of the view order.
        progress: Optional callback.

    Returns:
        New opacities [N] and a report with the loss of the first and the last round of views.
    """
    from gsfluent.geometry import rgb_to_sh0
    from gsfluent.ops import rasterize

    device, dtype = gaussians.means.device, gaussians.dtype
    surface = ~interior
    colors = gaussians.colors().clone()
    colors[interior] = 1.0 - colors[interior]
    sh = gaussians.sh.clone()
    sh[interior] = 0.0
    sh[interior, 0] = rgb_to_sh0(colors[interior])
    logit = torch.logit(gaussians.opacities[interior].clamp(0.02, 0.98)).requires_grad_(True)
    optimizer = torch.optim.Adam([logit], lr=0.4)
    frozen = gaussians.opacities.detach()
    rng = np.random.default_rng(seed)
    order: list[int] = []
    losses: list[float] = []
    for step in range(iterations):
        if not order:
            order = list(rng.permutation(len(capture.cameras)))
        image, mask, camera = capture.image(int(order.pop()), max_size=image_size)
        image = image.to(device, dtype)
        opacity = frozen.clone()
        opacity[interior] = torch.sigmoid(logit)
        rendered = rasterize(
            gaussians.means,
            opacity,
            camera.viewmat.to(device, dtype),
            camera.K.to(device, dtype),
            camera.width,
            camera.height,
            quats=gaussians.quats,
            scales=gaussians.scales,
            sh=sh,
            depth=False,
        )
        if mask is None:
            # without a mask the background is unknown: judge only where the surface itself is seen
            with torch.no_grad():
                weight = rasterize(
                    gaussians.means[surface],
                    frozen[surface],
                    camera.viewmat.to(device, dtype),
                    camera.K.to(device, dtype),
                    camera.width,
                    camera.height,
                    quats=gaussians.quats[surface],
                    scales=gaussians.scales[surface],
                    sh=gaussians.sh[surface],
                    depth=False,
                ).alpha
            loss = (weight[..., None] * (rendered.image - image) ** 2).mean()
            loss = loss + ((1 - weight) * rendered.alpha**2).mean()
        else:
            target = mask.to(device, dtype)
            loss = (target[..., None] * (rendered.image - image) ** 2).mean()
            loss = loss + ((1 - target) * rendered.alpha**2).mean()
        # what no photograph can see stays opaque: a weak pull towards the starting value
        loss = loss + 1e-4 * ((torch.sigmoid(logit) - _INTERIOR_OPACITY) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        report_progress(progress, step + 1, iterations, "interior opacity")
    views = min(len(capture.cameras), max(1, iterations // 2))
    report = {
        "opacity_loss_first": float(np.mean(losses[:views])),
        "opacity_loss_last": float(np.mean(losses[-views:])),
    }
    result = frozen.clone()
    result[interior] = torch.sigmoid(logit.detach()).to(dtype)
    return result, report
