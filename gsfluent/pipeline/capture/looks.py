"""What the photographs say about surface voxels: which cameras see one, and in which colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.pipeline.capture.views import TrainView

_ALONE = 0.9  # coverage of a pixel that shows the object alone
_FACING = 0.25  # cosine between normal and ray below which a camera does not count
_BEHIND = 1.5  # voxels behind the drawn surface that are still on it
_WRONG = 0.1  # share of the cameras at either end that may be wrong about a voxel
_FEWEST = 4  # cameras that must see a voxel before they can disagree
_TRUSTED = 2.0  # sum of cosines from which colours have a variance


@dataclass(frozen=True)
class Look:
    """One view, about as coarse as the voxels; pixels in rows, P = H * W."""

    color: Tensor  # mean colours [1, 3, H, W]
    low: Tensor  # least colour within a pixel of each [P, 3]
    high: Tensor  # greatest one [P, 3]
    alone: Tensor  # pixels that show nothing but the object, bool [P]
    front: Tensor  # depth of what has been drawn, inf where nothing was [P]
    viewmat: Tensor  # world to camera [4, 4]
    K: Tensor  # intrinsics [3, 3]

    @staticmethod
    def of(view: TrainView, middle: Tensor, voxel: float) -> Look:
        """Make a masked view as coarse as voxels [world units] around a point [3]."""
        assert view.mask is not None  # callers pass masked views
        depth = float((view.viewmat[:3, :3] @ middle + view.viewmat[:3, 3])[2])
        times = max(1, round(float(view.K[0, 0]) * voxel / max(depth, 1e-6)))
        bottom, right = (-side % times for side in view.mask.shape)
        planes = torch.cat([view.color.movedim(-1, 0), view.mask[None]])
        planes = functional.avg_pool2d(functional.pad(planes, (0, right, 0, bottom)), times)
        color, cover = planes[:3] / planes[3].clamp_min(1e-3), planes[3]
        alone = cover > _ALONE
        low = -functional.max_pool2d(torch.where(alone, -color, -torch.inf), 3, 1, 1)
        high = functional.max_pool2d(torch.where(alone, color, -torch.inf), 3, 1, 1)
        K = view.K.clone()
        K[:2] /= times
        return Look(
            color[None],
            low.flatten(1).T.contiguous(),
            high.flatten(1).T.contiguous(),
            alone.flatten(),
            torch.full_like(cover, torch.inf).flatten(),
            view.viewmat,
            K,
        )

    def drawn(self, points: Tensor) -> Look:
        """The look with surface voxels at points [N, 3] in it, three pixels wide."""
        at, on, depth, _ = self._place(points)
        front = torch.full_like(self.front, torch.inf)
        front.scatter_reduce_(0, at[on], depth[on], "amin")
        wide = -functional.max_pool2d(-front.view(1, *self.color.shape[2:]), 3, 1, 1)
        return replace(self, front=torch.minimum(self.front, wide.flatten()))

    def sees(self, points: Tensor, normals: Tensor, voxel: float) -> tuple[Tensor, Tensor, Tensor]:
        """Which surface voxels at points [N, 3] it sees.

        Returns:
            The pixels of the points, int64 [N]; whether it sees them, bool [N]; cosine between
            normal and ray [N].
        """
        at, on, depth, _ = self._place(points)
        eye = -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]
        facing = (functional.normalize(eye - points, dim=1) * normals).sum(1)
        # a pixel of a slanted surface spans depths
        slope = (facing.clamp_min(_FACING).square().reciprocal() - 1.0).sqrt()
        near = depth <= self.front[at] + voxel * (_BEHIND + 1.5 * slope)
        return at, on & self.alone[at] & (facing > _FACING) & near, facing

    def at(self, points: Tensor) -> Tensor:
        """Colours between pixels at points [N, 3], [N, 3]."""
        _, _, _, pixel = self._place(points)
        height, width = self.color.shape[2:]
        place = 2.0 * pixel / pixel.new_tensor([width, height]) - 1.0
        found = functional.grid_sample(
            self.color, place[None, None], padding_mode="border", align_corners=False
        )
        return found[0, :, 0].T

    def _place(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Row of the pixel, whether it is in the picture, depth, place [px] of points."""
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = local[:, 2]
        pixel = (local @ self.K.T)[:, :2] / depth.clamp_min(1e-6)[:, None]
        column, row = pixel.floor().long().unbind(1)
        height, width = self.color.shape[2:]
        on = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return row.clamp(0, height - 1) * width + column.clamp(0, width - 1), on, depth, pixel


def disagreement(looks: Sequence[Look], points: Tensor, normals: Tensor, voxel: float) -> Tensor:
    """How far apart the colours are that cameras see at surface voxels.

    A camera allows all colours within a pixel of where it sees the voxel. What is returned is the
    gap between the highest lower bound and the lowest upper one, the greatest over the channels;
    negative when one colour suits all. A tenth of the cameras may be wrong at either end.

    Args:
        looks: Views with the surface drawn.
        points: Centres of voxels [N, 3].
        normals: Outward normals [N, 3].
        voxel: Edge of a voxel [world units].

    Returns:
        Differences of colours in [0, 1], [N]; -inf where fewer than four cameras look.
    """
    lows = points.new_full((len(looks), len(points), 3), -torch.inf)
    highs = points.new_full((len(looks), len(points), 3), torch.inf)
    seen = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for index, look in enumerate(looks):
        at, sees, _ = look.sees(points, normals, voxel)
        lows[index, sees], highs[index, sees] = look.low[at[sees]], look.high[at[sees]]
        seen += sees
    wrong = (_WRONG * seen).long().view(1, -1, 1).expand(1, -1, 3)
    highest = lows.sort(0, descending=True).values.gather(0, wrong)
    lowest = highs.sort(0).values.gather(0, wrong)
    apart = (highest - lowest)[0].amax(1)
    apart[seen < _FEWEST] = -torch.inf
    return apart


def variances(
    looks: Sequence[Look], points: Tensor, normals: Tensor, voxel: float, below: Sequence[float]
) -> Tensor:
    """Variance of the colours over the cameras, had the surface been so far below.

    Who looks is told at the surface itself; views are weighted with the cosine of their slant.

    Args:
        looks: Views with the surface drawn.
        points: Centres of surface voxels [N, 3].
        normals: Outward normals [N, 3].
        voxel: Edge of a voxel [world units].
        below: Depths [voxels], D of them.

    Returns:
        Means over the channels, [D, N]; inf where hardly anybody looks.
    """
    weights = points.new_zeros(len(points), 1)
    sums = points.new_zeros(len(below), 2, len(points), 3)
    for look in looks:
        _, sees, facing = look.sees(points, normals, voxel)
        rows = sees.nonzero()[:, 0]
        weight = facing[rows, None]
        weights[rows] += weight
        for index, deep in enumerate(below):
            color = look.at(points[rows] - deep * voxel * normals[rows])
            sums[index, 0, rows] += weight * color
            sums[index, 1, rows] += weight * color.square()
    mean, square = (sums / weights.clamp_min(1e-6)).unbind(1)
    found = (square - mean.square()).clamp_min(0.0).mean(2)
    found[:, weights[:, 0] < _TRUSTED] = torch.inf
    return found
