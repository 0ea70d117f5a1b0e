"""Cavities that no silhouette shows, carved out of a visual hull by the colours over their lids."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.capture.looks import Look, disagreement, variances
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.spatial.voxels import distance_transform, grown, surface

_log = logging.getLogger(__name__)

Bools = NDArray[np.bool_]

_MOST = 64  # views, evenly chosen
_LEAST = 0.02  # difference of colours below which nothing is said
_SURE = 2.5  # times that: what goes by its colours alone; nearer ones are compared with others
_NOISE = 3.0  # times the median difference over the hull: one that is significant
_RESTLESS = 0.08  # median difference from which light or exposure changed too much
_PATCH = 7  # voxels across the smallest mouth
_ODD = 0.85  # share of the skin in such a patch that disagrees over a mouth
_RIM = 3  # voxels around a lid that may belong to it: there few cameras look in
_DEEP = 4.0  # voxels that a cavity reaches below the hull
_AGREED = 0.5  # share of a cavity's floor on which the cameras agree
_FEW = 3  # voxels: when fewer go, none does
_STEP = 2.0  # voxels below its surface at which a layer is compared with itself
_FALL = 0.1  # share of the variance that must be gone there
_FLOOR = 0.003**2  # change of the variance that is none
_WINDOW = 5  # voxels over which variances are averaged
_BULGE = 0.5  # share of matter around a voxel below which the surface bulges
_AROUND = 7  # voxels across that ball
_NEAR = 3  # voxels around what has gone that are asked next


def carve_cavities(hull: Hull, views: list[TrainView]) -> tuple[Hull, dict[str, Any]]:
    """Take out of a hull the cavities that its colours betray.

    Cameras that look at one place of a matte skin see one colour. Through the lid with which a hull
    closes a cavity they see several places of its wall. First the voxels of such a lid go whose
    colours disagree, layer by layer (Kutulakos and Seitz 2000). Then, while the variance of the
    colours is less two voxels below, or is no other and the surface bulges, the next layer goes.
    Skin on which the cameras agreed at first stays, with the layer below it. A cavity stays filled
    that reaches less than four voxels deep, or whose floor does not agree.

    Args:
        hull: Visual hull.
        views: Masked views.

    Returns:
        The hull, itself when nothing was carved; and ``cavities`` (how many), ``carved`` (share of
        the hull), ``disagreement`` (median over the hull's skin, None when not known), ``why``.
    """
    low, high = hull.bounds()
    middle = 0.5 * (low + high)
    chosen = views[:: -(-len(views) // _MOST)]
    looks = [Look.of(view, middle, hull.voxel) for view in chosen]
    notes: dict[str, Any] = {"cavities": 0, "carved": 0.0, "disagreement": None}

    def closed(why: str) -> tuple[Hull, dict[str, Any]]:
        _log.info("hull: %s", why)
        return hull, notes | {"why": why}

    solid: Bools = hull.occupancy.cpu().numpy()
    skin = surface(solid)
    cells = np.argwhere(skin)
    apart = _apart(hull, solid, cells, _with(hull, looks, cells))
    known = apart[np.isfinite(apart)]
    if len(known) < 0.5 * len(cells):
        return closed("too few photographs see the same skin to compare its colours")
    noise = max(0.0, float(np.median(known)))
    notes["disagreement"] = round(noise, 4)
    if noise > _RESTLESS:
        return closed("photographs disagree on colours everywhere, so no cavity was looked for")
    limit = max(_LEAST, _NOISE * noise)
    lid = _lid(skin, cells[apart > limit])
    if not lid.any():
        return closed("no cavity shows in the colours")
    carved = _carved(hull, solid, lid, looks, _SURE * limit)
    carved, count = _believed(hull, solid, carved, looks, limit)
    if count == 0:
        return closed("colours disagree, but over no cavity whose floor agrees")
    notes |= {"cavities": count, "carved": 1.0 - float(carved.sum()) / float(solid.sum())}
    why = f"colours show {count} cavities, {100 * notes['carved']:.0f} % of the hull"
    _log.info("hull: %s", why)
    inside = torch.from_numpy(carved).to(hull.occupancy.device)
    return Hull(inside, hull.origin, hull.voxel), notes | {"why": why}


def _centers(hull: Hull, cells: NDArray[np.int64]) -> Tensor:
    return hull.centers(torch.from_numpy(cells).to(hull.origin.device))


def _with(hull: Hull, looks: list[Look], cells: NDArray[np.int64]) -> list[Look]:
    """The looks with surface voxels drawn."""
    points = _centers(hull, cells)
    return [look.drawn(points) for look in looks]


def _normals(hull: Hull, solid: Bools, cells: NDArray[np.int64]) -> Tensor:
    """Outward normals of voxels from the blurred occupancy, [N, 3]."""
    soft = torch.from_numpy(solid)[None, None].float()
    for _ in range(2):
        soft = functional.avg_pool3d(soft, 3, 1, 1)
    slopes = [slope[tuple(cells.T)] for slope in torch.gradient(soft[0, 0])]
    return -functional.normalize(torch.stack(slopes, -1), dim=1).to(hull.origin)


def _apart(
    hull: Hull, solid: Bools, cells: NDArray[np.int64], looks: list[Look]
) -> NDArray[np.float32]:
    """Disagreement at voxels of the surface, [N]."""
    normals = _normals(hull, solid, cells)
    found: NDArray[np.float32] = (
        disagreement(looks, _centers(hull, cells), normals, hull.voxel).cpu().numpy()
    )
    return found


def _lid(skin: Bools, odd: NDArray[np.int64]) -> Bools:
    """Voxels around what disagrees and is as wide as a mouth somewhere, bool [X, Y, Z].

    A rim, an edge of the hull or a highlight is narrower.
    """
    from scipy import ndimage

    marked = np.zeros_like(skin)
    marked[tuple(odd.T)] = True
    share = _mean(marked, _PATCH) / np.maximum(_mean(skin, _PATCH), 1e-6)
    wide = marked & (share > _ODD)
    if not wide.any():
        return wide
    cube = np.ones((3, 3, 3), dtype=bool)
    return grown(ndimage.binary_propagation(wide, cube, marked), _RIM)


def _mean(values: NDArray[Any], size: int) -> NDArray[np.float32]:
    from scipy import ndimage

    found: NDArray[np.float32] = ndimage.uniform_filter(
        values.astype(np.float32), size, mode="constant"
    )
    return found


def _carved(hull: Hull, solid: Bools, lid: Bools, looks: list[Look], limit: float) -> Bools:
    """The solid without what disagrees below its lid, nor what hangs before the best agreement."""
    skin = surface(solid)
    agreed = skin & ~lid
    free = solid & (~grown(agreed, 1) | (skin & lid))
    looks = _with(hull, looks, np.argwhere(agreed))

    def disagrees(solid: Bools, cells: NDArray[np.int64], looks: list[Look]) -> Bools:
        return _apart(hull, solid, cells, looks) > limit

    def hangs(solid: Bools, cells: NDArray[np.int64], looks: list[Look]) -> Bools:
        at = tuple(cells.T)
        normals = _normals(hull, solid, cells)
        points = _centers(hull, cells)
        here, below = variances(looks, points, normals, hull.voxel, (0.0, _STEP)).cpu().numpy()
        told = np.isfinite(here)
        share = _mean(_spread(solid.shape, at, told), _WINDOW)[at]
        here, below = (
            _mean(_spread(solid.shape, at, np.where(told, value, 0.0)), _WINDOW)[at]
            / np.maximum(share, 1e-9)
            for value in (here, below)
        )
        change = np.maximum(_FLOOR, _FALL * here)
        bulges = _mean(solid, _AROUND)[at] < _BULGE
        better: Bools = told & ((here - below > change) | (bulges & (below - here <= change)))
        return better

    for judge in (disagrees, hangs):
        solid = _peeled(hull, solid, free, looks, judge)
    return solid


def _spread(shape: tuple[int, ...], at: tuple[Any, ...], values: Any) -> NDArray[np.float32]:
    """A grid with values at some voxels, 0 elsewhere."""
    grid = np.zeros(shape, dtype=np.float32)
    grid[at] = values
    return grid


_Judge = Callable[[Bools, NDArray[np.int64], list[Look]], Bools]


def _peeled(hull: Hull, solid: Bools, free: Bools, looks: list[Look], judge: _Judge) -> Bools:
    """Take layers off where it is allowed until the judge lets what is left stay."""
    solid = solid.copy()
    asked = free
    for _ in range(3 * max(solid.shape)):
        loose = surface(solid) & free
        cells = np.argwhere(loose & asked)
        gone = cells[:0]
        if len(cells):
            gone = cells[judge(solid, cells, _with(hull, looks, np.argwhere(loose)))]
        if len(gone) >= _FEW:
            solid[tuple(gone.T)] = False
            marked = np.zeros_like(solid)
            marked[tuple(gone.T)] = True
            asked = grown(marked, _NEAR)
        elif asked is free:
            break
        else:  # nothing near the last layer; what it uncovered for other cameras is asked
            asked = free
    return solid


def _believed(
    hull: Hull, solid: Bools, carved: Bools, looks: list[Look], limit: float
) -> tuple[Bools, int]:
    """The carved solid with shallow dents, and those that no floor confirms, filled again."""
    from scipy import ndimage

    removed = solid & ~carved
    label, count = ndimage.label(removed, np.ones((3, 3, 3)))
    if count == 0:
        return solid, 0
    names = np.arange(1, count + 1)
    depth = distance_transform(np.pad(solid, 1))[1:-1, 1:-1, 1:-1]
    deep = ndimage.maximum(depth, label, names) > _DEEP
    skin = surface(carved)
    beside = ndimage.maximum_filter(label, 3)
    cells = np.argwhere(skin & (beside > 0))
    kept = np.zeros(count + 1, dtype=bool)
    if len(cells):
        apart = _apart(hull, carved, cells, _with(hull, looks, np.argwhere(skin)))
        known = np.isfinite(apart)
        owner = beside[tuple(cells.T)][known]
        told = np.bincount(owner, minlength=count + 1)
        fine = np.bincount(owner, apart[known] <= limit, minlength=count + 1)
        kept[1:] = deep & ((fine > _AGREED * told) & (told > 0))[1:]
    return solid & ~kept[label], int(kept.sum())
