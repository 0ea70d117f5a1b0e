"""True pictures of a fracture: the solid in its true colours, cut into pieces that move rigidly.

The judge of splats that were carried through a break. The rest solid is a dense cloud of voxels,
cut by the converged partition of the pieces that there are in the end
(:mod:`gsfluent.lab.truth.true_pieces`), and each moves with the best rigid fit to its points, from
the first moment on: a crack that is not through yet but already a hinge is open. Soft matter stays
bent; then the fit may be a polynomial of degree two, which knows nothing of single points. So faces
are clean in the truth, and a bead is an error. Nothing here knows of splats, nor of how pieces are
drawn.

Only voxels that can be seen are kept: those beside nothing or beside another piece. They are drawn
as opaque points in a z-buffer, several per pixel, and averaged down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.lab.truth.true_pieces import CHIP, Displacement, bent_fit, partition, rigid_fit
from gsfluent.spatial.zbuffer import nearest_points

LEAST = 3
"""Points that make a piece; of less there is dust, which goes where it lay."""
COVER = 0.9
"""Radius of a voxel in voxels: half the diagonal of a face, and a little."""
_LAYERS = 2
"""Layers of voxels drawn behind each exposed face, so that points do not let one see past them."""


@dataclass(frozen=True)
class TruePicture:
    """What a camera sees of the cloud."""

    image: Tensor  # display colours over the background, float32 [H, W, 3]
    alpha: Tensor  # share of each pixel that is covered, float32 [H, W]
    depth: Tensor  # camera z of the matter [m], mean over the covered part, 0 where none, [H, W]


class TrueSolid:
    """A solid of known inside and its true pieces.

    Args:
        inside: Which points [N, 3] (float64, rest coordinates) are matter.
        colors: True colours in 0..1 of points inside, [N, 3].
        bounds: Lower and upper corner of a box around the solid, float64 [3] each.
        voxel: Edge of a voxel [m].
        rest: Material points at rest [m], [P, 3].
        unit: What each hangs together with in the end, int64 [P], -1 for nothing.
        spacing: Their mean distance [m].
        displacement: Of the faces; None for smooth ones.

    Attributes:
        rest: Voxels that could be seen, at rest [m], float32 [M, 3].
        label: Piece of each, int64 [M].
        volumes: Volume of every piece [m^3], [F].
    """

    def __init__(
        self,
        inside: Callable[[Tensor], Tensor],
        colors: Callable[[Tensor], Tensor],
        bounds: tuple[Tensor, Tensor],
        voxel: float,
        rest: Tensor,
        unit: Tensor,
        spacing: float,
        displacement: Displacement | None = None,
    ) -> None:
        from scipy.spatial import cKDTree

        self.colors, self.voxel, self.spacing = colors, float(voxel), float(spacing)
        low, high = (corner.double() for corner in bounds)
        origin = low - voxel
        shape = tuple(math.ceil(float(n) / voxel - 1e-6) + 2 for n in high - low)
        self.points = rest.double().numpy()
        _, of, count = torch.unique(unit, return_inverse=True, return_counts=True)
        seeds = (unit >= 0) & (count[of] >= LEAST)
        self._piece = torch.where(seeds, of, -1).numpy()
        names, compact = np.unique(self._piece[seeds.numpy()], return_inverse=True)
        self._piece[seeds.numpy()] = compact
        tree = cKDTree(self.points[seeds.numpy()])
        nearest = np.full(shape, -1, np.int32)
        for x in range(shape[0]):
            index = np.indices((1, *shape[1:])).reshape(3, -1).T.copy()
            index[:, 0] = x
            place = origin + (torch.from_numpy(index).double() + 0.5) * voxel
            matter = inside(place).numpy()
            if matter.any():
                nearest[x].reshape(-1)[matter] = compact[tree.query(place.numpy()[matter])[1]]
        shift = None
        if displacement is not None and len(names) > 1:
            where = np.stack(np.nonzero(nearest >= 0), 1)
            moved = displacement(origin.numpy() + (where + 0.5) * voxel) / voxel
            shift = np.zeros((3, *shape), np.float32)
            shift[(slice(None), *where.T)] = moved.T
        label = partition(nearest, np.bincount(compact), spacing / voxel, shift)
        self.volumes = np.bincount(label[label >= 0], minlength=len(names)) * voxel**3
        index = np.stack(np.nonzero(_exposed(label)), 1)
        self.rest = (origin + (torch.from_numpy(index).double() + 0.5) * voxel).float()
        self.label = torch.from_numpy(label[tuple(index.T)]).long()

    def moved(self, position: Tensor, *, bent: bool = False) -> Tensor:
        """Where the voxels are [m], float32 [M, 3].

        Args:
            position: Material points now [m], [P, 3].
            bent: Pieces bend as their points do on the whole (:func:`bent_fit`).
        """
        now, rest = position.double().numpy(), self.rest.double().numpy()
        places = np.empty_like(rest)
        for piece in range(len(self.volumes)):
            rows, mine = self._piece == piece, self.label.numpy() == piece
            turn, move = rigid_fit(self.points[rows], now[rows], self.spacing)
            places[mine] = rest[mine] @ turn.T + move
            if bent and rows.sum() >= CHIP:
                places[mine] = bent_fit(self.points[rows], now[rows], self.spacing)(rest[mine])
        return torch.from_numpy(places).float()

    def draw(
        self,
        position: Tensor,
        camera: Camera,
        *,
        samples: int = 3,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> TruePicture:
        """Draw voxels [M, 3] as opaque points, ``samples`` x ``samples`` per pixel."""
        fine = camera.resized(samples * camera.width, samples * camera.height)
        first = nearest_points(position, COVER * self.voxel, fine)
        hit = first >= 0
        z = position @ fine.viewmat[2, :3].float() + float(fine.viewmat[2, 3])
        seen, back = first[hit].unique(return_inverse=True)
        image = torch.tensor(background).expand(*first.shape, 3).contiguous()
        if len(seen):
            image[hit] = self.colors(self.rest[seen].double()).float()[back]
        depth = torch.zeros(first.shape)
        depth[hit] = z[first[hit]]
        alpha = _mean(hit.float(), samples)
        return TruePicture(
            torch.stack([_mean(image[..., k], samples) for k in range(3)], -1),
            alpha,
            torch.where(alpha > 0, _mean(depth, samples) / alpha.clamp(min=1e-6), 0.0),
        )


def _exposed(label: np.ndarray) -> np.ndarray:
    """Voxels beside nothing or beside another piece, and the layers behind them, bool."""
    matter = label >= 0
    found = np.zeros_like(matter)
    for axis in range(3):
        a, b = _pair(axis, 0), _pair(axis, 1)
        differs = label[a] != label[b]
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


def _pair(axis: int, side: int) -> tuple[slice, ...]:
    cut = slice(1, None) if side else slice(None, -1)
    return tuple(cut if k == axis else slice(None) for k in range(3))


def _mean(image: Tensor, samples: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image[None, None], samples)[0, 0]
