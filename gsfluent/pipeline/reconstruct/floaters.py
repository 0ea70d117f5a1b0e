"""Floaters out of a reconstruction: what hangs in the air, what no camera needs, what is no matter.

A trained cloud explains photographs; a solid is made of what of it is the object's surface. Every
Gaussian is looked at from the cameras: where the rendered surface lies behind it, light passes
where it claims to be. What goes is counted by reason, and what it costs is measured in decibels.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import BACKGROUND, Camera, Gaussians, projected
from gsfluent.draw import draw, draw_at
from gsfluent.errors import InputError
from gsfluent.metrics import psnr
from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.spatial.density import choose_grid, density_field
from gsfluent.spatial.shape import robust_box

_log = logging.getLogger(__name__)

REASONS = (
    "non_finite",
    "outside_hull",
    "huge",
    "needle",
    "free_space",
    "few_views",
    "unseen",
    "apart",
)
"""Why a Gaussian goes; each is counted under the first reason that holds."""

_MOST_CAMERAS = 48  # evenly chosen; more say the same again
_LONGEST_SIDE = 480  # pixels of the pictures looked at
_GRID = 64  # cells per side where pieces are told apart
_JOINED = 0.1  # density from which a cell belongs to a piece
_GIVEN_BACK = (0.1, 0.25, 0.5, 0.75)  # shares tried when cleaning costs too much


@dataclass(frozen=True)
class CleanLimits:
    """Limits of :func:`clean_floaters`; lengths are shares of the object's largest extent.

    Args:
        hull_slack: Voxels that a centre may lie outside the hull.
        huge: Standard deviation above which a Gaussian is no part of a surface.
        aspect: Longest over middle axis of a needle.
        needle: Standard deviation from which a needle matters.
        depth: Distance before the rendered surface from which a Gaussian is in free space.
        views: Cameras that must see it.
        weight: Sum of blend weights [pixels] from which a camera sees it.
        piece: Share of the cloud's mass from which something apart is a piece, not a floater.
        budget: Decibels that cleaning may cost; the most visible are given back beyond that.
    """

    hull_slack: int = 2
    huge: float = 0.12
    aspect: float = 12.0
    needle: float = 0.03
    depth: float = 0.05
    views: int = 2
    weight: float = 0.05
    piece: float = 0.01
    budget: float = 0.05


@dataclass
class _Witness:
    """What the cameras say about each Gaussian: [N] each."""

    weight: Tensor  # sum of blend weights over all pictures [px]
    seen: Tensor  # cameras with at least `limits.weight`
    framed: Tensor  # cameras whose picture holds its centre
    front: Tensor  # cameras that see the surface behind it, or nothing at all
    at: Tensor  # cameras that see the surface where it is


@torch.no_grad()
def clean_floaters(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    hull: Hull | None = None,
    photographs: Sequence[Tensor] | None = None,
    limits: CleanLimits | None = None,
) -> tuple[Gaussians, dict[str, Any]]:
    """Remove what floats.

    A Gaussian goes when it is not finite, lies outside the hull, is huge or a needle, lies before
    the surface that the cameras see (more often than on it), is seen by fewer than ``views``
    cameras although they look at it and nothing confirms it, adds to no picture, or hangs apart
    from every piece of the object. Those labelled ``BACKGROUND`` stay and only hide what is behind.

    Args:
        gaussians: A reconstruction; the object's Gaussians, or all with labels.
        cameras: Cameras that it was trained on.
        hull: Where the object can be, or None.
        photographs: What each camera saw, before black, float [H, W, 3]: with them the effect is
            measured, and kept below ``limits.budget``.
        limits: What counts as a floater.

    Returns:
        The Gaussians that stay, in their order, and the report: ``gaussians_before, gaussians,
        removed`` (their number), ``reasons`` (number by reason), ``contribution`` (share of all
        blend weights that went), ``given_back``, ``cameras``, ``psnr_before, psnr_after`` [dB]
        (None without photographs).

    Raises:
        InputError: No cameras, or photographs that do not belong to them.
    """
    limits = limits or CleanLimits()
    if not cameras:
        raise InputError("clean: there are no cameras", "give those of the reconstruction")
    if photographs is not None and len(photographs) != len(cameras):
        raise InputError(
            f"clean: {len(photographs)} photographs for {len(cameras)} cameras", "give one for each"
        )
    chosen = _evenly(len(cameras), _MOST_CAMERAS)
    used = [cameras[i] for i in chosen]
    targets = None if photographs is None else [photographs[i] for i in chosen]
    mine = torch.ones(gaussians.count, dtype=torch.bool, device=gaussians.device)
    if gaussians.labels is not None:
        mine = gaussians.labels != BACKGROUND
    reason, weight = _reasons(gaussians, mine, used, hull, limits)
    gone = reason >= 0
    report: dict[str, Any] = {"gaussians_before": gaussians.count, "cameras": len(used)}
    before = after = None
    given_back = 0
    if targets is not None:
        before = _quality(gaussians, used, targets)
        after = _quality(gaussians.select(~gone), used, targets)
        # The brightest of them carry the picture; what is not finite goes all the same.
        ordered = (reason > 0).nonzero()[:, 0]
        ordered = ordered[weight[ordered].argsort(descending=True)]
        for share in (*_GIVEN_BACK, 1.0):
            if after >= before - limits.budget:
                break
            given_back = math.ceil(share * len(ordered))
            gone[ordered[:given_back]] = False
            after = _quality(gaussians.select(~gone), used, targets)
    counts = torch.bincount(reason[gone], minlength=len(REASONS)).tolist()
    total = float(weight[mine].sum())
    report |= {
        "gaussians": int((~gone).sum()),
        "removed": int(gone.sum()),
        "reasons": {name: int(n) for name, n in zip(REASONS, counts, strict=True) if n},
        "contribution": float(weight[gone].sum()) / total if total > 0 else 0.0,
        "given_back": given_back,
        "psnr_before": None if before is None else round(before, 3),
        "psnr_after": None if after is None else round(after, 3),
    }
    _log.info("clean: %d of %d Gaussians are floaters", report["removed"], gaussians.count)
    if bool(gone[mine].all()) and bool(mine.any()):
        raise InputError(
            f"clean: all {int(mine.sum())} Gaussians of the object look like floaters",
            "check that the cameras belong to the splats, or skip the cleaning",
        )
    return gaussians.select(~gone), report


@torch.no_grad()
def floating(
    gaussians: Gaussians,
    views: Sequence[TrainView],
    hull: Hull | None,
    limits: CleanLimits | None = None,
) -> Tensor:
    """Which Gaussians :func:`clean_floaters` would take whatever it costs, bool [N].

    In training: what the photographs lose by it, the rest still has time to learn.
    """
    mine = torch.ones(gaussians.count, dtype=torch.bool, device=gaussians.device)
    chosen = [views[i] for i in _evenly(len(views), _MOST_CAMERAS)]
    reason, _ = _reasons(gaussians, mine, _cameras(chosen), hull, limits or CleanLimits())
    return reason >= 0


def _cameras(views: Sequence[TrainView]) -> list[Camera]:
    # one copy from the device for all
    viewmats = torch.stack([view.viewmat for view in views]).double().cpu()
    lenses = torch.stack([view.K for view in views]).double().cpu()
    return [
        Camera(viewmat, K, *view.size)
        for viewmat, K, view in zip(viewmats, lenses, views, strict=True)
    ]


def clean_views(
    gaussians: Gaussians,
    views: Sequence[TrainView],
    *,
    hull: Hull | None = None,
    limits: CleanLimits | None = None,
) -> tuple[Gaussians, dict[str, Any]]:
    """As :func:`clean_floaters`, with the views that a reconstruction trained on."""
    photographs = [view.color for view in views]
    return clean_floaters(
        gaussians, _cameras(views), hull=hull, photographs=photographs, limits=limits
    )


def _evenly(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def _reasons(
    gaussians: Gaussians,
    mine: Tensor,
    cameras: Sequence[Camera],
    hull: Hull | None,
    limits: CleanLimits,
) -> tuple[Tensor, Tensor]:
    """Index into :data:`REASONS`, -1 for those that stay, int64 [N]; and blend weights [N]."""
    finite = torch.isfinite(gaussians.means).all(1) & torch.isfinite(gaussians.opacities)
    for value in (gaussians.scales, gaussians.quats, gaussians.sh.flatten(1)):
        finite &= torch.isfinite(value).all(1)
    visible = mine & finite & (gaussians.opacities > 0.1)
    points = gaussians.means[visible].double().cpu().numpy()
    found = {"non_finite": ~finite}
    extent = 0.0
    if len(points) >= 8:
        low, high = robust_box(points)
        extent = float((high - low).max())
    scales = gaussians.scales.nan_to_num()
    ordered = scales.sort(dim=1).values
    if hull is not None:
        found["outside_hull"] = ~hull.contains(gaussians.means.nan_to_num(), limits.hull_slack)
    if extent > 0:
        found["huge"] = ordered[:, 2] > limits.huge * extent
        long = ordered[:, 2] > limits.needle * extent
        found["needle"] = long & (ordered[:, 2] > limits.aspect * ordered[:, 1])
    seen = _witness(gaussians, cameras, ordered[:, 2], extent, limits)
    found["free_space"] = (seen.front >= 3) & (seen.front > 2 * seen.at)
    looked = (seen.framed >= limits.views + 2) & (seen.at < limits.views)
    found["few_views"] = (seen.seen < limits.views) & (seen.seen > 0) & looked
    found["unseen"] = (seen.seen == 0) & (seen.framed > 0)
    reason = torch.full((gaussians.count,), -1, dtype=torch.int64, device=gaussians.device)
    for index, name in enumerate(REASONS):
        if name in found:
            reason[mine & found[name] & (reason < 0)] = index
    stays = mine & (reason < 0)
    apart = _apart(gaussians.select(stays), limits.piece)
    reason[stays.nonzero()[:, 0][apart]] = REASONS.index("apart")
    return reason, seen.weight


def _witness(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    longest: Tensor,
    extent: float,
    limits: CleanLimits,
) -> _Witness:
    """Look at every Gaussian from every camera."""
    zero = torch.zeros(gaussians.count, device=gaussians.device)
    seen = _Witness(zero, zero.clone(), zero.clone(), zero.clone(), zero.clone())
    slack = limits.depth * extent + 2.0 * longest
    means = gaussians.means.nan_to_num(nan=1e9)
    points, looks = means.double(), [_small(camera) for camera in cameras]
    # where the splats are, all at once: a copy to a GPU takes as long as a picture
    views, lenses = (
        torch.stack([getattr(camera, name) for camera in looks]).to(points)
        for name in ("viewmat", "K")
    )
    for camera, view, lens in zip(looks, views, lenses, strict=True):
        size = (camera.width, camera.height)
        result = draw_at(gaussians, view, lens, size, contribution=True, median_depth=True)
        assert result.contribution is not None and result.median_depth is not None
        pixel, z = (found.to(means) for found in projected(points, view, lens))
        column, row = pixel.floor().clamp(-1, 1e6).long().unbind(1)
        on = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
        alpha, depth = result.alpha[row, column], result.median_depth[row, column]
        solid = on & (alpha > 0.5)
        seen.weight = seen.weight + result.contribution
        seen.seen += result.contribution >= limits.weight
        seen.framed += on
        seen.front += (solid & (z < depth - slack)) | (on & (alpha < 0.25))
        seen.at += solid & ((z - depth).abs() <= slack)
    return seen


def _apart(gaussians: Gaussians, piece: float) -> Tensor:
    """Gaussians that hang together with no piece of at least this share of the mass, bool [N]."""
    from scipy import ndimage

    if gaussians.count < 16:
        return torch.zeros(gaussians.count, dtype=torch.bool, device=gaussians.device)
    box, _ = choose_grid(gaussians.means, gaussians.opacities, _GRID)
    density = (
        density_field(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, box)
        .cpu()
        .numpy()
    )
    label, count = ndimage.label(density > _JOINED, structure=np.ones((3, 3, 3)))
    mass = np.bincount(label.ravel(), weights=density.ravel(), minlength=count + 1)
    mass[0] = 0.0
    wanted = mass >= piece * mass.sum()
    place = (gaussians.means.double().cpu().numpy() - np.array(box.origin)) / box.voxel
    index = np.floor(place).astype(int)
    size = np.array(box.shape)
    on = ((index >= 0) & (index < size)).all(1)
    inside = wanted[label[tuple(np.clip(index, 0, size - 1).T)]]
    return torch.from_numpy(~(on & inside)).to(gaussians.device)


def _quality(gaussians: Gaussians, cameras: Sequence[Camera], targets: Sequence[Tensor]) -> float:
    """Mean PSNR [dB] of the pictures before black."""
    total = 0.0
    for camera, target in zip(cameras, targets, strict=True):
        image = draw(gaussians, camera).image.clamp(0.0, 1.0)
        total += min(psnr(image, target.to(image)), 100.0)
    return total / len(cameras)


def _small(camera: Camera) -> Camera:
    """The pinhole camera of the same view, at most :data:`_LONGEST_SIDE` pixels long."""
    pinhole = camera.replace(distortion=())
    longest = max(camera.width, camera.height)
    return pinhole if longest <= _LONGEST_SIDE else pinhole.scaled(_LONGEST_SIDE / longest)
