"""True pictures of a fracture: the solid as a dense cloud of voxels in its true colours.

The judge of splats that were carried through a break. Every voxel belongs to the material point
that was nearest at rest and moves with a smooth blend of that point and those of its neighbours
that it still hangs together with: points of the same piece, so that no gap opens inside a piece,
and, outside of pieces (broken points, crumbs), points that have not parted from it by more than
``parted`` times their distance at rest. With ``parted = 1`` every crumb moves rigidly and alone.
Nothing here knows of splats.

Only voxels that can be seen are moved: those beside a voxel that is empty or has parted from them.
They are drawn as opaque points in a z-buffer, several per pixel, and averaged down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Camera
from gsfluent.spatial.zbuffer import nearest_points

_NEIGHBOURS = 16
"""Material points whose motions are blended: all within two spacings."""
_SIGMA = 0.6
"""Width of the blend in point spacings."""
_STRETCH = (0.6, 1.5)
"""Stretches beyond are no deformation of matter in one piece."""
_LAYERS = 2
"""Layers of voxels drawn behind each exposed face, so that points do not let one see past them."""
_COVER = 0.9
"""Radius of a voxel in voxels: half the diagonal of a face that is stretched to ``PARTED``."""
_CHUNK = 100_000
PARTED = 1.5
"""Neighbours at this many times their distance at rest leave a gap one can see."""


@dataclass(frozen=True)
class ExposedVoxels:
    """The voxels of one moment that a camera could see."""

    rest: Tensor  # where they were at rest [m], float32 [M, 3]
    position: Tensor  # where they are [m], float32 [M, 3]
    owner: Tensor  # material point of each, int64 [M]


@dataclass(frozen=True)
class TruePicture:
    """What a camera sees of the cloud."""

    image: Tensor  # display colours over the background, float32 [H, W, 3]
    alpha: Tensor  # share of each pixel that is covered, float32 [H, W]
    depth: Tensor  # camera z of the matter [m], mean over the covered part, 0 where none, [H, W]


class TrueCloud:
    """A solid of known inside, bound to its material points.

    Args:
        inside: Which points [N, 3] (float64, rest coordinates) are matter.
        colors: True colours in 0..1 of points inside, [N, 3].
        bounds: Lower and upper corner of a box around the solid, float64 [3] each.
        voxel: Edge of a voxel [m].
        rest: Material points at rest [m], [P, 3].
        spacing: Their mean distance [m].
        parted: Broken neighbours have parted at this many times their distance at rest; at 1 they
            always have.
    """

    def __init__(
        self,
        inside: Callable[[Tensor], Tensor],
        colors: Callable[[Tensor], Tensor],
        bounds: tuple[Tensor, Tensor],
        voxel: float,
        rest: Tensor,
        spacing: float,
        *,
        parted: float = PARTED,
    ) -> None:
        from scipy.spatial import cKDTree

        self.colors, self.voxel, self.spacing = colors, float(voxel), float(spacing)
        low, high = (corner.double() for corner in bounds)
        self.origin = low - voxel
        shape = [math.ceil(float(n) / voxel - 1e-6) + 2 for n in high - low]
        self.rest, self.parted = rest.float(), parted
        points = rest.double().numpy()
        tree = cKDTree(points)
        self._near = torch.from_numpy(
            tree.query(points, k=min(_NEIGHBOURS, len(points)))[1].reshape(len(points), -1)
        ).long()
        # -1 is empty
        self._owner = np.full(shape, -1, np.int32)
        for x in range(shape[0]):
            index = np.indices((1, *shape[1:])).reshape(3, -1).T.copy()
            index[:, 0] = x
            centers = self._centers(torch.from_numpy(index))
            matter = inside(centers).numpy()
            if matter.any():
                found = tree.query(centers.numpy()[matter])[1]
                self._owner[x].reshape(-1)[matter] = found

    def _centers(self, index: Tensor) -> Tensor:
        return self.origin + (index.double() + 0.5) * self.voxel

    def exposed(self, position: Tensor, deformation: Tensor, fragments: Tensor) -> ExposedVoxels:
        """Find and move the voxels that could be seen.

        Args:
            position: Material points now [m], [P, 3].
            deformation: Their total deformation gradients, [P, 3, 3].
            fragments: Piece of each point, int [P], -1 for debris.
        """
        position, fragments = position.float(), fragments.long()
        index = np.argwhere(self._faces(position, fragments))
        owner = torch.from_numpy(self._owner[tuple(index.T)]).long()
        rest = self._centers(torch.from_numpy(index)).float()
        moved, _ = self.follow(rest, owner, position, deformation, fragments)
        return ExposedVoxels(rest, moved, owner)

    def owners(self, points: Tensor) -> Tensor:
        """Material point nearest at rest to each of some points [N, 3], int64 [N]."""
        from scipy.spatial import cKDTree

        found = cKDTree(self.rest.double().numpy()).query(points.double().numpy())[1]
        return torch.from_numpy(found).long()

    def follow(
        self,
        points: Tensor,
        owner: Tensor,
        position: Tensor,
        deformation: Tensor,
        fragments: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Move places of the solid with the matter.

        Args:
            points: Places at rest [m], float32 [N, 3].
            owner: Material point of each, int64 [N].
            position: Material points now [m], [P, 3].
            deformation: Their total deformation gradients, [P, 3, 3].
            fragments: Piece of each point, int [P], -1 for debris.

        Returns:
            The places now [m], [N, 3], and the map of small vectors there, [N, 3, 3].
        """
        position, fragments = position.float(), fragments.long()
        rotation, stretch = ops.polar_clamped(deformation.float().contiguous(), *_STRETCH)
        # debris has no shape of its own to keep: it turns, and that is all that is known of it
        local = torch.where((fragments < 0)[:, None, None], rotation, stretch)
        point = torch.arange(len(self.rest))[:, None].expand_as(self._near)
        together = self._together(point, self._near, position, fragments)
        places, maps = torch.empty_like(points), points.new_empty(len(points), 3, 3)
        for rows in torch.arange(len(points)).split(_CHUNK):
            near = self._near[owner[rows]]
            arm = points[rows][:, None] - self.rest[near]
            weight = torch.exp(-0.5 * arm.square().sum(-1) / (_SIGMA * self.spacing) ** 2)
            # far from all points the nearest still carries
            weight = weight.clamp(min=1e-12) * together[owner[rows]]
            weight = weight / weight.sum(1, keepdim=True)
            moved = position[near] + (local[near] @ arm[..., None])[..., 0]
            places[rows] = (weight[..., None] * moved).sum(1)
            maps[rows] = (weight[..., None, None] * local[near]).sum(1)
        return places, maps

    def _together(self, a: Tensor, b: Tensor, position: Tensor, fragments: Tensor) -> Tensor:
        """Whether points a and b (rows, any shape) hang together."""
        one, other = fragments[a], fragments[b]
        whole = (one == other) & (one >= 0)
        apart = (position[a] - position[b]).square().sum(-1)
        held = apart < self.parted**2 * (self.rest[a] - self.rest[b]).square().sum(-1)
        loose = (one < 0) | (other < 0)
        return (a == b) | whole | (loose & held if self.parted > 1.0 else torch.zeros_like(whole))

    def _faces(self, position: Tensor, fragments: Tensor) -> np.ndarray:
        """Voxels beside an empty one or one that has parted, and the layers behind them."""
        owner = self._owner
        matter = owner >= 0
        found = np.zeros_like(matter)
        for axis in range(3):
            a, b = _pair(axis, 0), _pair(axis, 1)
            differs = owner[a] != owner[b]
            both = np.nonzero(differs & matter[a] & matter[b])
            one, other = (torch.from_numpy(owner[side][both]).long() for side in (a, b))
            held = self._together(one, other, position, fragments)
            differs[tuple(k[held.numpy()] for k in both)] = False
            found[a] |= differs
            found[b] |= differs
        for _ in range(_LAYERS - 1):
            grown = found.copy()
            for axis in range(3):
                a, b = _pair(axis, 0), _pair(axis, 1)
                grown[a] |= found[b]
                grown[b] |= found[a]
            found = grown & matter
        return found & matter

    def draw(
        self,
        voxels: ExposedVoxels,
        camera: Camera,
        *,
        samples: int = 3,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> TruePicture:
        """Draw voxels as opaque points, ``samples`` x ``samples`` per pixel."""
        fine = camera.resized(samples * camera.width, samples * camera.height)
        first = nearest_points(voxels.position, _COVER * self.voxel, fine)
        hit = first >= 0
        z = voxels.position @ fine.viewmat[2, :3].float() + float(fine.viewmat[2, 3])
        seen, back = first[hit].unique(return_inverse=True)
        image = torch.tensor(background).expand(*first.shape, 3).contiguous()
        if len(seen):
            image[hit] = self.colors(voxels.rest[seen].double()).float()[back]
        depth = torch.zeros(first.shape)
        depth[hit] = z[first[hit]]
        alpha = _mean(hit.float(), samples)
        return TruePicture(
            torch.stack([_mean(image[..., k], samples) for k in range(3)], -1),
            alpha,
            torch.where(alpha > 0, _mean(depth, samples) / alpha.clamp(min=1e-6), 0.0),
        )


def _pair(axis: int, side: int) -> tuple[slice, ...]:
    cut = slice(1, None) if side else slice(None, -1)
    return tuple(cut if k == axis else slice(None) for k in range(3))


def _mean(image: Tensor, samples: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image[None, None], samples)[0, 0]
