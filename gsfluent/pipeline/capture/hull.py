"""The visual hull of masked photographs, and what all cameras look at."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from gsfluent.data import Capture, View
from gsfluent.errors import InputError
from gsfluent.ops.spatial import trilinear
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.spatial.density import GridBox
from gsfluent.spatial.voxels import distance_transform, surface

Array = NDArray[np.float64]
_View = TypeVar("_View")

_SCRAP = 0.3  # share of the largest body of a hull below which another one is a scrap
_COARSE = 40  # cells per side of the first hull
_COARSE_SIZE = 128  # pixels of the masks then: finer than a voxel
_COARSE_VIEWS = 24
_RIM = 8  # voxels around a hull in which the distance from it is exact
_AGREE = 0.9  # share of them that must agree on a voxel; one bad mask must not cut the object


@dataclass(frozen=True)
class Hull:
    """Voxels that every mask allows to be object."""

    occupancy: Tensor  # bool [X, Y, Z]
    origin: Tensor  # corner of voxel (0, 0, 0), float32 [3]
    voxel: float  # edge length, world units

    def centers(self, index: Tensor) -> Tensor:
        """Centres of voxels ``index`` [M, 3]."""
        return self.origin + (index + 0.5) * self.voxel

    @functools.cached_property
    def points(self) -> Tensor:
        """Centres of all its voxels [M, 3]."""
        return self.centers(self.occupancy.nonzero())

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner of the occupied voxels, [3] each."""
        index = self.occupancy.nonzero()
        return (
            self.origin + index.amin(0) * self.voxel,
            self.origin + (index.amax(0) + 1) * self.voxel,
        )

    def contains(self, points: Tensor, slack: int = 0) -> Tensor:
        """Which points [N, 3] lie in the hull grown by ``slack`` voxels, bool [N]."""
        grown = self._grown(slack)
        index = ((points - self.origin) / self.voxel).floor().long()
        size = torch.tensor(grown.shape, device=points.device)
        on = ((index >= 0) & (index < size)).all(1)
        index = torch.minimum(index.clamp_min(0), size - 1)
        return on & grown[index[:, 0], index[:, 1], index[:, 2]]

    def _grown(self, slack: int) -> Tensor:
        """The occupancy grown by some voxels: a training asks for the same at each look."""
        if slack not in self._wider:
            self._wider[slack] = _dilated(self.occupancy, slack)
        return self._wider[slack]

    @functools.cached_property
    def _wider(self) -> dict[int, Tensor]:
        return {}

    def beyond(self, points: Tensor) -> Tensor:
        """How far points [N, 3] lie outside the hull [world units], 0 in it, [N].

        Between the centres of voxels it is interpolated; off the grid, the distance to the grid is
        added, a bound from above.
        """
        size = torch.tensor(self._beyond.shape, device=points.device)
        # a rim of _RIM voxels around the grid
        place = (points - self.origin.to(points)) / self.voxel + (_RIM - 0.5)
        held = torch.minimum(place.clamp_min(0.0), (size - 1).to(place))
        away = trilinear(self._beyond.to(points), held) + (place - held).norm(dim=1)
        return away * self.voxel

    def distances(self) -> tuple[Tensor, list[float]]:
        """How far the points of a grid lie outside the hull [voxels], and where the first lies."""
        return self._beyond, [x - (_RIM - 0.5) * self.voxel for x in self._corner]

    @functools.cached_property
    def _corner(self) -> list[float]:
        return [float(x) for x in self.origin]  # read once: it waits for the device

    @functools.cached_property
    def _beyond(self) -> Tensor:
        """Distances of the voxels outside from the boundary [voxels], with a rim."""
        outside = functional.pad(~self.occupancy, (_RIM,) * 6, value=True).cpu().numpy()
        away = np.where(outside, distance_transform(outside) - 0.5, 0.0)
        return torch.from_numpy(away.astype(np.float32)).to(self.occupancy.device)


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
        spot = view.viewmat[:3, :3] @ middle + view.viewmat[:3, 3]
        depth = float(spot[2])
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
    start = lower.to(views[0].color.device)
    points = start + lattice(shape, start.device) * voxel
    kept = carved(points, views, lambda part, view: ~_allowed(part, view, voxel), allowed)
    return Hull(kept.view(shape), start, voxel)


def lattice(shape: Sequence[int], device: torch.device | None = None) -> Tensor:
    """Centres of the voxels of a grid in voxels, float32 [X * Y * Z, 3]."""
    axes = [torch.arange(n, device=device, dtype=torch.float32) + 0.5 for n in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def carved(
    points: Tensor,
    views: Iterable[_View],
    denied: Callable[[Tensor, _View], Tensor],
    allowed: int,
) -> Tensor:
    """Points [N, 3] that at most so many views deny, bool [N]; what is gone is asked no more.

    Args:
        points: World positions.
        views: What has seen them.
        denied: Which of the points [M, 3] a view denies, bool [M].
        allowed: Views that may be wrong about a point.
    """
    alive = torch.arange(len(points), device=points.device)
    misses = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    for view in views:
        misses[alive] += denied(points[alive], view).int()
        alive = alive[misses[alive] <= allowed]
        if len(alive) == 0:  # views may ask for the median depth of what is left
            break
    return misses <= allowed


Ground = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pixels known to show something else than the object, bool [H, W]; world to camera [4, 4]; K."""


def centre_hull(
    box: GridBox, views: Sequence[Ground], device: torch.device | None = None
) -> np.ndarray:
    """Voxels whose centre falls inside the mask of (nearly) every view that sees it.

    One stray mask must not cut the object in two: from eight views on, two views have to agree
    before a voxel goes. Voxels outside every image are kept.

    Args:
        box: The grid.
        views: What is not the object.
        device: Where to compute.

    Returns:
        Hull bool [X, Y, Z].
    """
    grid = lattice(box.shape, device)
    points = grid * box.voxel + grid.new_tensor(box.origin)

    def outside(points: Tensor, view: Ground) -> Tensor:
        ground, viewmat, intrinsics = view
        height, width = ground.shape
        pose, lens = points.new_tensor(viewmat), points.new_tensor(intrinsics)
        camera = points @ pose[:3, :3].T + pose[:3, 3]
        z = camera[:, 2]
        u, v = ((camera @ lens.T)[:, :2] / z[:, None]).unbind(1)
        seen = (z > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        column, row = torch.where(seen, u, 0).long(), torch.where(seen, v, 0).long()
        return seen & torch.from_numpy(ground).to(points.device)[row, column]

    kept = carved(points, views, outside, 1 if len(views) >= 8 else 0)
    return kept.view(box.shape).cpu().numpy()


def _allowed(points: Tensor, view: TrainView, voxel: float) -> Tensor:
    """Whether voxels at ``points`` [N, 3] touch the mask of a view, or lie out of its sight."""
    assert view.mask is not None
    row, column, on, depth = view.locate(points)
    footprint = 0.5 * voxel * float(view.K[0, 0])
    grow = max(1, math.ceil(footprint / max(float(depth.median()), 1e-6)))
    grown = functional.max_pool2d(view.mask[None, None], 2 * grow + 1, 1, grow)[0, 0]
    keep = grown[row, column] > 0.5
    # Off the crop means off the mask, unless the mask touches the edge of the photograph.
    unseen = torch.full_like(keep, _touches_edge(view.mask)) | (depth <= 0)
    return torch.where(on, keep, unseen)


def contradiction(hull: Hull, view: TrainView) -> float:
    """Share of the hull that the mask of a view denies; large when that mask misses a part."""
    return 1.0 - float(_allowed(hull.points, view, hull.voxel).float().mean())


def _touches_edge(mask: Tensor) -> bool:
    edge = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool((edge > 0.5).any())


def _dilated(occupancy: Tensor, cells: int) -> Tensor:
    if cells == 0:
        return occupancy
    grown = occupancy[None, None].float()
    # one axis after the other: a cube in one go takes (2 cells + 1)^2 / 3 times as long
    for axis in range(3):
        size, pad = [1, 1, 1], [0, 0, 0]
        size[axis], pad[axis] = 2 * cells + 1, cells
        grown = functional.max_pool3d(grown, size, 1, pad)
    return grown[0, 0] > 0.5


def masked_views(capture: Capture) -> list[View]:
    """Read evenly chosen photographs, small, those that come with a mask."""
    step = max(1, len(capture) // _COARSE_VIEWS)
    views = [capture.view(index, _COARSE_SIZE) for index in range(0, len(capture), step)]
    return [view for view in views if view.mask is not None]


def inside_masks(views: list[View], points: Tensor, least: float = 0.0) -> Array:
    """Share of the views with each point [N, 3] inside their mask, [N]; out of view is outside.

    Points that cannot reach ``least`` any more are not looked for in further views.
    """
    votes = torch.zeros(len(points), dtype=torch.float64)
    left = torch.arange(len(points))
    masked = [view for view in views if view.mask is not None]
    for number, view in enumerate(masked, 1):
        assert view.mask is not None
        pixels, depth = view.camera.project(points)
        place = pixels.floor().long()
        limit = torch.tensor([view.camera.width, view.camera.height])
        seen = (depth > 0) & (place >= 0).all(dim=1) & (place < limit).all(dim=1)
        seen[seen.clone()] = view.mask[place[seen, 1], place[seen, 0]] > 0.5
        votes[left[seen]] += 1.0
        kept = (votes[left] + len(masked) - number) / max(1, len(views)) >= least
        left, points = left[kept], points[kept]
    return np.asarray((votes / max(1, len(views))).numpy())


def hull_points(capture: Capture, focus: Array) -> tuple[Array, Array]:
    """Surface of the visual hull: points [M, 3] and their colours [M, 3]; empty without masks.

    Args:
        capture: Photographs with masks.
        focus: Point the cameras look at [3].
    """
    views = masked_views(capture)
    grid, inside = hull_grid(views, capture, focus)
    if not inside.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    points = grid[surface(inside)]
    return points, _colors(views, points)


def hull_grid(
    views: list[View], capture: Capture, focus: Array, voxels: int = _COARSE
) -> tuple[Array, NDArray[np.bool_]]:
    """Lattice around the visual hull.

    Args:
        views: From :func:`masked_views`; fewer than three see nothing.
        capture: Photographs they are of.
        focus: Point the cameras look at [3].
        voxels: Points of the lattice along each axis, V.

    Returns:
        Its points [V, V, V, 3], and which of them lie in the hull, bool [V, V, V]; where nothing
        does the lattice may be coarser or finer.
    """
    reach = float(np.median(np.linalg.norm(capture.centers().numpy() - focus, axis=1)))
    low, high = focus - 0.6 * reach, focus + 0.6 * reach
    grid, inside = np.zeros((*(voxels,) * 3, 3)), np.zeros((voxels,) * 3, dtype=bool)
    # each round fits the grid to what the last left, and only the last has to be fine; the first
    # is made finer where it finds nothing: a pane lies between the points of a coarse one
    counts = [voxels // 2, voxels, 2 * voxels] if len(views) >= 3 else []
    while counts:
        count = counts.pop(0)
        axes = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        shares = inside_masks(views, torch.from_numpy(grid.reshape(-1, 3)), _AGREE)
        seen, inside = inside.any(), (shares >= _AGREE).reshape((count,) * 3)
        if not inside.any():
            if seen:
                break
            continue
        if not seen:
            counts = [min(count, voxels), voxels]
        occupied = grid[inside]
        margin = 1.5 * (high - low) / (count - 1)
        low, high = occupied.min(axis=0) - margin, occupied.max(axis=0) + margin
    return grid, inside


def _colors(views: list[View], points: Array) -> Array:
    """Colour of each point in the view that faces it most."""
    outward = torch.from_numpy(points - points.mean(axis=0))
    best = torch.full((len(points),), -np.inf, dtype=torch.float64)
    colors = torch.full((len(points), 3), 0.5, dtype=torch.float64)
    for view in views:
        facing = outward @ (view.camera.center() - torch.from_numpy(points.mean(axis=0)))
        pixels, _ = view.camera.project(torch.from_numpy(points))
        limit = torch.tensor([view.camera.width - 1, view.camera.height - 1])
        place = torch.minimum(pixels.floor().long().clamp_min(0), limit)
        better = facing > best
        colors[better] = view.image[place[better, 1], place[better, 0]].double()
        best = torch.maximum(best, facing)
    return np.asarray(colors.numpy())
