"""Gaussians inside a solid: as fine as the splats of the skin where they meet it, coarser inward.

Matter is cut into pieces that hold one Gaussian each. The pieces are stretches of a Hilbert curve
(Skilling 2004) with equal shares of the wanted density, so the spacing follows depth smoothly, the
result depends on nothing but the seed, and the work is one sort.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import INTERIOR, SURFACE, Gaussians
from gsfluent.pipeline.solid.colors import surface_colors
from gsfluent.spatial.density import GridBox
from gsfluent.spatial.neighbours import nearest
from gsfluent.spatial.pieces import hilbert_code, sample, signed_depth, small_pieces
from gsfluent.spatial.voxels import grown

INTERIOR_OPACITY = 0.98
_SIGMA_PER_SPACING = 0.45
_CORE = 1.25  # voxels between Gaussians far from the skin: what a texture volume can show
_FINEST = 0.5  # voxels; finer splats would repeat one colour of the volume
_GROWTH = 0.3  # growth of the spacing per depth
_FINER = 0.75  # of the skin's splats: leaves a narrower gap below the skin
_STANDOFF = 1.25  # standard deviations between the outermost centres and the skin
_ROOM = 0.5  # voxels; the largest stand-off


class Matter(NamedTuple):
    """Voxels to be filled."""

    solid: np.ndarray
    """Matter, bool [X, Y, Z]."""
    depth: np.ndarray
    """Depth below the surface [world units], float32 [X, Y, Z]; 0 outside."""
    nearest: np.ndarray
    """Index of the nearest outer voxel [3, X, Y, Z]."""
    box: GridBox
    """The grid."""


class Placed(NamedTuple):
    """Where interior Gaussians sit."""

    centers: Tensor
    """World positions, float64 [M, 3]."""
    sigmas: Tensor
    """Standard deviations [world units], float64 [M]."""
    depths: Tensor
    """Depth below the skin [world units], float64 [M]."""


def interior_gaussians(
    inside: Tensor,
    depth: Tensor,
    origin: Tensor,
    voxel: float,
    *,
    skin: Tensor | float,
    core: float | None = None,
    max_count: int = 200_000,
    seed: int = 0,
) -> Placed:
    """Spread Gaussians through matter, as fine as the skin's splats at the skin.

    The spacing is ``min(core, skin + 0.3 depth)``; when that asks for more than ``max_count``
    Gaussians, all spacings grow by one factor. The standard deviation is 0.45 of it, and
    nowhere more than 0.8 of the depth, so that nothing sticks out.

    Args:
        inside: Voxels, bool [X, Y, Z].
        depth: Depth below the surface [X, Y, Z], world units.
        origin: Corner of voxel (0, 0, 0) [3], world units.
        voxel: Edge of a voxel, world units.
        skin: Spacing at the skin, world units: one number, or for every voxel that of the skin
            nearest to it [X, Y, Z]. Kept between half a voxel and ``core``.
        core: Largest spacing, world units; None takes 1.25 voxels.
        max_count: Upper bound on the number of Gaussians.
        seed: Seed of the jitter.

    Returns:
        Centres, standard deviations and depths, on the device of ``inside``.

    Raises:
        ValueError: ``core`` or ``max_count`` is not positive, or shapes differ.
    """
    if inside.shape != depth.shape:
        raise ValueError(
            f"interior_gaussians: inside {list(inside.shape)} and depth {list(depth.shape)} differ"
        )
    widest = _CORE if core is None else core / voxel
    if not (widest > 0 and max_count > 0):
        raise ValueError(
            f"interior_gaussians: core and max_count must be > 0, got {core}, {max_count}"
        )
    device = inside.device
    field = signed_depth(inside, depth / voxel)
    index = inside.nonzero()
    near = torch.as_tensor(skin, dtype=torch.float32, device=device).expand(inside.shape)[inside]
    near = (near / voxel).clamp(min=min(_FINEST, widest), max=widest)
    wanted = _spacing(near, field[inside], widest)
    # one factor for all spacings, so that the count stays below the bound
    factor = max(1.0, float((wanted.double() ** -3).sum() / max_count) ** (1 / 3))
    point, row, volume = small_pieces(index, factor * wanted, seed)
    deep = sample(field, point)
    reach = near[row]
    # thin parts have no room for the whole stand-off
    room = (_STANDOFF * _SIGMA_PER_SPACING * factor * reach).clamp(max=_ROOM)
    kept = deep > room
    point, reach = point[kept], reach[kept]
    mass = volume[kept] * (factor * _spacing(reach, deep[kept], widest)) ** -3
    if len(point) == 0:
        none = point.new_zeros(0).double()
        return Placed(point.double(), none, none)
    # the stand-off left some matter out
    better = max(1.0, factor * float(mass.double().sum() / max_count) ** (1 / 3))
    mass, factor = mass * (factor / better) ** 3, better
    bits = math.ceil(math.log2(8 * max(inside.shape)))
    order = hilbert_code((point * 8.0).long(), bits).argsort(stable=True)
    # On the host from here on: a GPU adds in an order that is chance.
    point, reach, mass = (v[order].cpu().double() for v in (point, reach, mass))
    total = mass.cumsum(0)
    count = min(max(1, round(float(total[-1]))), max_count)
    stretch = ((total - 0.5 * mass) * (count / float(total[-1]))).long().clamp(0, count - 1)
    share = torch.zeros(count, dtype=torch.float64).index_add_(0, stretch, mass)

    def mean(value: Tensor) -> Tensor:
        """Averages over the stretches."""
        sums = torch.zeros((count, *value.shape[1:]), dtype=torch.float64)
        sums.index_add_(0, stretch, mass.view(-1, *[1] * (value.dim() - 1)) * value)
        return (sums[share > 0] / share[share > 0].view(-1, *[1] * (value.dim() - 1))).to(device)

    middle, skin_spacing = mean(point), mean(reach)
    deep = sample(field, middle)
    # the middle of a bent piece may lie outside a crevice that the piece goes around
    kept = deep > 0
    middle, deep, skin_spacing = middle[kept], deep[kept], skin_spacing[kept]
    spread = _SIGMA_PER_SPACING * factor * _spacing(skin_spacing, deep, widest)
    spread = torch.minimum(spread, (deep / _STANDOFF).clamp_min(0.1).double())
    start = origin.to(device, torch.float64)
    return Placed(start + middle * voxel, spread * voxel, deep.double() * voxel)


def _spacing(skin: Tensor, depth: Tensor, widest: float) -> Tensor:
    """Distance between Gaussians [voxels] at some depth, where the skin's splats are ``skin``."""
    return (skin + _GROWTH * depth.to(skin)).clamp(max=widest)


def splat_sizes(gaussians: Gaussians, points: np.ndarray, cell: float) -> np.ndarray:
    """Standard deviation along the surface of the splats around some points.

    Args:
        gaussians: Splats; with labels, only the SURFACE ones are used.
        points: [M, 3] world units.
        cell: About the distance of the nearest splats, world units.

    Returns:
        Geometric mean of the two larger scales, averaged over the eight nearest splats with their
        opacity, float64 [M], world units.
    """
    if gaussians.labels is not None:
        gaussians = gaussians.select(gaussians.labels == SURFACE)
    scales = gaussians.scales.detach().double().sort(dim=1).values.cpu().numpy()
    size = 0.5 * np.log(np.maximum(scales[:, 1] * scales[:, 2], 1e-300))
    alpha = gaussians.opacities.detach().double().cpu().numpy() + 1e-4
    _, rank = nearest(gaussians.means, points, min(8, gaussians.count), cell)
    weight = alpha[rank]
    result: np.ndarray = np.exp((weight * size[rank]).sum(1) / weight.sum(1))
    return result


def populate(
    surface: Gaussians,
    matter: Matter,
    *,
    spacing: float | None,
    max_interior: int,
    seed: int,
) -> tuple[Gaussians, Tensor, dict[str, Any]]:
    """Append interior Gaussians that wear the colour of the surface nearest to them.

    Args:
        surface: Splats of the shell.
        matter: Where the interior is.
        spacing: Largest distance between interior Gaussians in voxels; None takes 1.25.
        max_interior: Upper bound on their number.
        seed: Seed of the jitter.

    Returns:
        All Gaussians, which of them are interior (bool [N]), and for the report ``spacing_skin,
        spacing_core`` (5 % and 95 % quantiles, voxels) and ``stray_splats``: how many splats of the
        shell hang two voxels or more outside the solid.
    """
    solid, depth, nearest, box = matter
    device, dtype = surface.means.device, surface.dtype
    index = np.argwhere(solid)
    # few distinct skin voxels serve many voxels; asking the tree from deep inside is slow
    skin = np.stack([axis[solid] for axis in nearest], axis=1)
    flat, back = np.unique(np.ravel_multi_index(tuple(skin.T), solid.shape), return_inverse=True)
    place = box.centers(np.stack(np.unravel_index(flat, solid.shape), axis=1))
    size = np.zeros(solid.shape, np.float32)
    if len(index):
        wide = splat_sizes(surface, place, box.voxel) * (_FINER / _SIGMA_PER_SPACING)
        size[solid] = wide[back.reshape(-1)]
    placed = interior_gaussians(
        torch.from_numpy(solid).to(device),
        torch.from_numpy(depth).to(device),
        torch.tensor(box.origin, dtype=torch.float64),
        box.voxel,
        skin=torch.from_numpy(size).to(device),
        core=None if spacing is None else spacing * box.voxel,
        max_count=max_interior,
        seed=seed,
    )
    count = len(placed.centers)
    inner = torch.zeros(surface.count + count, dtype=torch.bool, device=device)
    inner[surface.count :] = True
    if count == 0:
        return surface, inner, {}
    row = np.zeros(solid.shape, np.int64)
    row[solid] = back.reshape(-1)
    at = ((placed.centers.cpu().numpy() - np.asarray(box.origin)) / box.voxel).astype(np.int64)
    color = surface_colors(surface, place, box.voxel)[row[tuple(at.T)]]
    interior = Gaussians.from_colors(
        placed.centers.to(device, dtype),
        placed.sigmas.to(device, dtype),
        torch.from_numpy(color).to(device, dtype),
        opacities=INTERIOR_OPACITY,
        label=INTERIOR,
    )
    ranked = (placed.sigmas / (_SIGMA_PER_SPACING * box.voxel)).sort().values
    notes = {
        "spacing_skin": float(ranked[count // 20]),
        "spacing_core": float(ranked[count - 1 - count // 20]),
        "stray_splats": _strays(surface, solid, box),
    }
    return Gaussians.cat([surface.replace(normals=None), interior]), inner, notes


def _strays(surface: Gaussians, solid: np.ndarray, box: GridBox) -> int:
    """Splats two voxels or more outside the solid; what is off the grid is outside."""
    near = grown(solid, 2)
    means = surface.means.detach().double().cpu().numpy()
    index = np.floor((means - np.asarray(box.origin)) / box.voxel).astype(np.int64)
    held = ((index >= 0) & (index < solid.shape)).all(1)
    inside = near[tuple(index[held].T)]
    return int(len(index) - inside.sum())
