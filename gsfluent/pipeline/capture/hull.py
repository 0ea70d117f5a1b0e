"""The visual hull of masked photographs, and what all cameras look at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.errors import InputError
from gsfluent.pipeline.capture.views import TrainView

_SCRAP = 0.3  # share of the largest body of a hull below which another one is a scrap


_COARSE = 40  # cells per side of the first hull


@dataclass(frozen=True)
class Hull:
    """Voxels that every mask allows to be object.

    Attributes:
        occupancy: bool [X, Y, Z].
        origin: Corner of voxel (0, 0, 0), float32 [3].
        voxel: Edge length, world units.
    """

    occupancy: Tensor
    origin: Tensor
    voxel: float

    def centers(self, index: Tensor) -> Tensor:
        """Centres of voxels ``index`` [M, 3]."""
        return self.origin + (index + 0.5) * self.voxel

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner of the occupied voxels, [3] each."""
        index = self.occupancy.nonzero()
        return (
            self.origin + index.amin(0) * self.voxel,
            self.origin + (index.amax(0) + 1) * self.voxel,
        )

    def contains(self, points: Tensor, slack: int = 0) -> Tensor:
        """Which points [N, 3] lie in the hull grown by ``slack`` voxels, bool [N]."""
        grown = _dilated(self.occupancy, slack)
        index = ((points - self.origin) / self.voxel).floor().long()
        size = torch.tensor(grown.shape, device=points.device)
        on = ((index >= 0) & (index < size)).all(1)
        index = torch.minimum(index.clamp_min(0), size - 1)
        return on & grown[index[:, 0], index[:, 1], index[:, 2]]


def focus_point(viewmats: Tensor) -> Tensor:
    """Point nearest to all optical axes in the least-squares sense, [3], from viewmats [C, 4, 4].

    A weak pull towards the mean camera keeps parallel axes solvable.
    """
    viewmats = viewmats.double()
    axis = viewmats[:, 2, :3]
    center = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[..., 0]
    project = (
        torch.eye(3, dtype=torch.float64, device=axis.device) - axis[:, :, None] * axis[:, None]
    )
    pull = 1e-6 * torch.eye(3, dtype=torch.float64, device=axis.device)
    right = (project @ center[..., None]).mean(0) + pull @ center.mean(0)[:, None]
    return torch.linalg.solve(project.mean(0) + pull, right)[:, 0]


def visual_hull(views: list[TrainView], resolution: int = 96, forgiven: float = 0.0) -> Hull:
    """Carve the space that every mask leaves, coarse to fine (Laurentini 1994).

    A voxel stays when its projection touches the mask in every view that sees it; at the coarse
    level the masks are grown by a voxel's footprint so that thin parts survive.

    Args:
        views: Masked views.
        resolution: Voxels along the longest side of the object.
        forgiven: Share of the views that may disagree, for masks that are not exact.

    Raises:
        InputError: Nothing is left, so masks and poses contradict each other.
    """
    viewmats = torch.stack([view.viewmat for view in views])
    middle = focus_point(viewmats).float()
    half = _reach(views, middle)
    allowed = int(forgiven * len(views))
    hull = _carve(views, middle - half, 2.0 * half / _COARSE, (_COARSE,) * 3, allowed)
    if not bool(hull.occupancy.any()):
        raise InputError(
            "reconstruct: the masks of the views have no common object",
            "check that masks are white on the object and that the poses belong to the images",
        )
    lower, upper = hull.bounds()
    voxel = float((upper - lower).max()) / resolution
    shape = [int(n) + 2 for n in ((upper - lower) / voxel).ceil()]
    fine = _carve(views, lower - voxel, voxel, (shape[0], shape[1], shape[2]), allowed)
    return _bodies(fine) if bool(fine.occupancy.any()) else _bodies(hull)


def _bodies(hull: Hull) -> Hull:
    """The hull without scraps that hang apart; objects photographed together all stay."""
    from scipy import ndimage

    pieces, count = ndimage.label(hull.occupancy.cpu().numpy(), structure=np.ones((3, 3, 3)))
    if count <= 1:
        return hull
    sizes = np.bincount(pieces.reshape(-1))
    sizes[0] = 0
    kept = np.nonzero(sizes >= _SCRAP * sizes.max())[0]
    body = torch.from_numpy(np.isin(pieces, kept)).to(hull.occupancy.device)
    return Hull(body, hull.origin, hull.voxel)


def _reach(views: list[TrainView], middle: Tensor) -> float:
    """Half side of a cube around ``middle`` that holds the object: the widest mask decides."""
    reach = []
    for view in views:
        assert view.mask is not None  # callers pass masked views
        depth = float((view.viewmat[:3, :3] @ middle + view.viewmat[:3, 3])[2])
        spot = view.viewmat[:3, :3] @ middle + view.viewmat[:3, 3]
        pixel = (view.K @ (spot / spot[2]))[:2]
        row, column = (view.mask > 0.5).nonzero().unbind(1)
        if depth <= 0 or len(row) == 0:
            continue
        far = torch.stack([(column - pixel[0]) / view.K[0, 0], (row - pixel[1]) / view.K[1, 1]])
        reach.append(float(far.norm(dim=0).max()) * depth)
    if not reach:
        raise InputError(
            "reconstruct: no camera looks at the masked object", "check poses and masks"
        )
    return 1.3 * max(reach)


def _carve(
    views: list[TrainView], lower: Tensor, voxel: float, shape: tuple[int, int, int], allowed: int
) -> Hull:
    """Voxels that at most ``allowed`` masks contradict."""
    device = views[0].color.device
    axes = [torch.arange(n, device=device, dtype=torch.float32) + 0.5 for n in shape]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = lower.to(device) + grid * voxel
    alive = torch.arange(len(points), device=device)
    misses = torch.zeros(len(points), dtype=torch.int32, device=device)
    for view in views:
        misses[alive] += (~_allowed(points[alive], view, voxel)).int()
        alive = alive[misses[alive] <= allowed]
    occupancy = torch.zeros(len(points), dtype=torch.bool, device=device)
    occupancy[alive] = True
    return Hull(occupancy.view(shape), lower.to(device), voxel)


def _allowed(points: Tensor, view: TrainView, voxel: float) -> Tensor:
    """Whether voxels at ``points`` [N, 3] touch the mask of a view, or lie out of its sight."""
    assert view.mask is not None
    local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    depth = local[:, 2]
    pixel = local @ view.K.T
    pixel = pixel[:, :2] / depth.clamp_min(1e-6)[:, None]
    footprint = 0.5 * voxel * float(view.K[0, 0])
    grow = max(1, math.ceil(footprint / max(float(depth.median()), 1e-6)))
    grown = functional.max_pool2d(view.mask[None, None], 2 * grow + 1, 1, grow)[0, 0]
    width, height = view.size
    column, row = pixel.floor().long().unbind(1)
    on = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    keep = grown[row.clamp(0, height - 1), column.clamp(0, width - 1)] > 0.5
    # Off the crop means off the mask, unless the mask touches the edge of the photograph.
    unseen = torch.full_like(keep, _touches_edge(view.mask)) | (depth <= 0)
    return torch.where(on, keep, unseen)


def contradiction(hull: Hull, view: TrainView) -> float:
    """Share of the hull that the mask of a view denies; large when that mask misses a part."""
    points = hull.centers(hull.occupancy.nonzero())
    return 1.0 - float(_allowed(points, view, hull.voxel).float().mean())


def _touches_edge(mask: Tensor) -> bool:
    edge = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool((edge > 0.5).any())


def _dilated(occupancy: Tensor, cells: int) -> Tensor:
    if cells == 0:
        return occupancy
    grown = functional.max_pool3d(occupancy[None, None].float(), 2 * cells + 1, 1, cells)
    return grown[0, 0] > 0.5
