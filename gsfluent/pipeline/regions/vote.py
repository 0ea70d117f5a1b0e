"""Votes of labelled photographs for the skin of a solid.

Every voxel of the skin is drawn as a small opaque splat. With one colour channel per label, the
picture is ``image[p, l] = sum_v w_v(p) c[v, l]``; its adjoint applied to the one-hot label map is
``votes[v, l] = sum of w_v(p) over the pixels p of label l``: one backward call of the rasterizer
counts, exactly and with occlusion, what share of each label's pixels every voxel makes up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.data import Gaussians, Solid
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.io.segmentation.masks import LabelView, Segmentation
from gsfluent.progress import Progress, report_progress

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


_CHANNELS = 32  # of one call of the rasterizer
_SIGMA = 0.6  # of a splat [voxels]: neighbours overlap, two layers let under 1 % through
_OPACITY = 0.99
_LAYERS = 1.6  # depth [voxels] of what is drawn, so that nothing shows through from behind
_SMOOTH = 2.0  # width [voxels] of the smoothing that finds the surface between voxels
_FACING = 0.15  # cosine below which a voxel is seen edge-on and its pixels are its neighbours'


@dataclasses.dataclass(frozen=True)
class Skin:
    """Voxels of a solid that border the outside."""

    index: NDArray[np.int64]  # voxels, int64 [S, 3], in row-major order
    normals: NDArray[np.float32]  # outward unit normals, float32 [S, 3]
    centers: NDArray[np.float32]  # centres, world units, float32 [S, 3]
    # where the surface passes by, found between voxels, world units, float32 [S, 3].
    surface: NDArray[np.float32]
    splats: Gaussians  # what is drawn: the skin first, then the layer below it
    neighbours: csr_matrix  # adjacency of the skin's voxels (26 neighbours), csr [S, S] of ones

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.index)


def find_skin(solid: Solid) -> Skin:
    """Find the voxels of a solid that border the outside; closed cavities are inside.

    Raises:
        InputError: The solid is empty.
    """
    from scipy import ndimage

    occupied = np.pad(solid.occupancy.cpu().numpy(), 2)
    if not occupied.any():
        raise InputError("regions: the solid holds no matter", "fill it first (gsfluent fill)")
    body = ndimage.binary_fill_holes(occupied)
    cross = ndimage.generate_binary_structure(3, 1)
    skin = occupied & ndimage.binary_dilation(~body, cross)
    below = body & ~skin & ndimage.binary_dilation(skin, iterations=max(1, round(_LAYERS) - 1))
    smooth = ndimage.gaussian_filter(np.pad(body, 4).astype(np.float32), _SMOOTH)[4:-4, 4:-4, 4:-4]
    index = np.argwhere(skin)
    slope = np.stack(np.gradient(smooth), -1)[tuple(index.T)]
    steep = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    normals = (-slope / steep).astype(np.float32)
    # the smoothed body is 1/2 on the surface; on thin parts it is lower everywhere, hence the limit
    offset = ((smooth[tuple(index.T)] - 0.5)[:, None] / steep).clip(-0.5, 1.0) * solid.voxel
    origin = np.array([float(part) for part in solid.origin])
    drawn = np.concatenate([index, np.argwhere(below)])
    centers = (origin + (drawn - 2 + 0.5) * solid.voxel).astype(np.float32)
    device = solid.occupancy.device
    splats = Gaussians.from_colors(
        torch.from_numpy(centers).to(device),
        torch.full((len(drawn),), _SIGMA * solid.voxel, device=device),
        torch.zeros(len(drawn), 3, device=device),
        opacities=_OPACITY,
    )
    return Skin(
        index - 2,
        normals,
        centers[: len(index)],
        (centers[: len(index)] + normals * offset).astype(np.float32),
        splats,
        _adjacency(index, skin.shape),
    )


def label_votes(gaussians: Gaussians, view: LabelView, labels: NDArray[np.int64]) -> Tensor:
    """Pixels of each label that every Gaussian makes up in one view.

    Args:
        gaussians: What is drawn.
        view: The label map and its camera.
        labels: Labels to count, [L].

    Returns:
        Sums of blend weights [N, L].
    """
    device = gaussians.means.device
    image = torch.from_numpy(view.labels).to(device)
    found = []
    for start in range(0, len(labels), _CHANNELS):
        wanted = torch.as_tensor(labels[start : start + _CHANNELS], device=device)
        shown = (image[..., None] == wanted).to(gaussians.means)
        colors = torch.zeros(
            gaussians.count, len(wanted), device=device, dtype=gaussians.dtype, requires_grad=True
        )
        with torch.enable_grad():
            drawn = draw(gaussians, view.camera, colors=colors, deterministic=True).image
            counted = (drawn * shown).sum()
        (votes,) = torch.autograd.grad(counted, colors)
        found.append(votes.detach())
    return torch.cat(found, dim=1) if found else torch.zeros(gaussians.count, 0, device=device)


def view_votes(
    skin: Skin, segmentation: Segmentation, progress: Progress | None = None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
    """Count the votes view by view.

    A voxel's votes of one view are weighted by how squarely it faces the camera; they add up to
    ``p / (p + m)`` of its ``p`` pixels there, ``m`` being the median over the voxels seen: a close
    photograph has more to say than a far one, but never drowns the others.

    Yields:
        The labels present, int64 [L], and the votes for them, float32 [S, L].
    """
    total = len(segmentation.views)
    for number, view in enumerate(segmentation.views):
        labels = np.unique(view.labels.astype(np.int64))
        labels = labels[labels >= (0 if segmentation.linked else 1)]
        votes = label_votes(skin.splats, view, labels)[: len(skin)].cpu().numpy()
        toward = view.camera.center().numpy() - skin.centers
        toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
        facing = (toward * skin.normals).sum(axis=1)
        votes = votes * np.where(facing > _FACING, facing, 0.0)[:, None]
        pixels = votes.sum(axis=1, keepdims=True)
        seen = pixels[pixels > 1e-3]
        usual = float(np.median(seen)) if seen.size else 1.0
        report_progress(progress, number + 1, total, "votes")
        yield labels, (votes / (pixels + usual)).astype(np.float32)


def cast_votes(
    skin: Skin, segmentation: Segmentation, progress: Progress | None = None
) -> NDArray[np.float32]:
    """Add up the votes of all views of a linked segmentation.

    Returns:
        Votes [S, L + 1] for nothing (0) and for each label in the order of its number.

    Raises:
        InputError: No photograph shows the solid.
    """
    numbers = np.array([0, *sorted(segmentation.names)], dtype=np.int64)
    total = np.zeros((len(skin), len(numbers)), np.float64)
    for labels, votes in view_votes(skin, segmentation, progress):
        place = np.searchsorted(numbers, labels).clip(max=len(numbers) - 1)
        known = numbers[place] == labels  # a label left out as rare is nobody's
        np.add.at(total.T, place[known], votes.T[known])
    if not total.any():
        raise InputError(
            f"{segmentation.source}: no labelled photograph shows the object",
            "check that the labels belong to the photographs that the splat was made from",
        )
    return total.astype(np.float32)


def _adjacency(index: NDArray[np.int64], size: tuple[int, ...]) -> csr_matrix:
    """Which of the voxels [S, 3] touch one another by face, edge or corner."""
    from scipy.sparse import csr_matrix

    number = np.full(size, -1, dtype=np.int64)
    number[tuple(index.T)] = np.arange(len(index))
    rows, columns = [], []
    for offset in np.ndindex(3, 3, 3):
        if offset == (1, 1, 1):
            continue
        other = number[tuple((index + np.array(offset) - 1).T)]  # the grid is padded
        rows.append(np.flatnonzero(other >= 0))
        columns.append(other[other >= 0])
    row, column = np.concatenate(rows), np.concatenate(columns)
    return csr_matrix((np.ones(len(row), np.float32), (row, column)), shape=(len(index),) * 2)
