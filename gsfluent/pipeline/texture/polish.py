"""Colours of coarse interior Gaussians fitted to the slices of a volume."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.pipeline.texture.volume.domain import InteriorDomain

_COARSE = 1.15  # voxels; Gaussians closer than this show the volume already when sampled


def polish_colors(
    domain: InteriorDomain,
    rgb: np.ndarray,
    means: np.ndarray,
    colors: np.ndarray,
    *,
    device: torch.device | None = None,
) -> tuple[np.ndarray, dict[str, Any]]:
    """Fit colours so that cuts through the Gaussians show the slices of the volume.

    Sampling a volume at the centres is the better start the finer the Gaussians are. Where they
    are coarser than voxels, what lies between the centres is lost that way; here the slices of all
    three axes, one per spacing, are the targets of a least-squares fit (:func:`.fuse_colors`).

    Args:
        domain: The region.
        rgb: Its colours, float32 [X, Y, Z, 3].
        means: Centres of the Gaussians in voxel units [N, 3].
        colors: Sampled colours [N, 3], kept where no slice shows a Gaussian.
        device: Where to compute.

    Returns:
        Colours [N, 3], and the report: spacing [voxels], polished (False: they are fine enough,
        and nothing was done), and the figures of :func:`.fuse_colors`.
    """
    where = torch.device("cpu") if device is None else device
    spacing = float(domain.inside.sum() / max(len(means), 1)) ** (1.0 / 3.0)
    if len(means) < 8 or spacing < _COARSE:
        return colors, {"polished": False, "spacing": spacing}
    # the skin's own splats show in the outermost voxels
    matter = domain.inside & ~domain.shell
    step = max(1, round(spacing))
    planes, targets, masks = [], [], []
    for axis in range(3):
        filled = np.flatnonzero(matter.any(tuple(i for i in range(3) if i != axis)))
        if len(filled) == 0:
            continue
        index = range(int(filled[0]), int(filled[-1]) + 1, step)
        planes += stack_planes(axis, index, matter.shape, torch.zeros(3, device=where), 1.0)
        targets += [torch.from_numpy(np.take(rgb, k, axis)) for k in index]
        masks += [torch.from_numpy(np.take(matter, k, axis)) for k in index]
    if not planes:
        return colors, {"polished": False, "spacing": spacing}
    fitted, report = fuse_colors(
        torch.from_numpy(means).to(where, torch.float32),
        planes,
        targets,
        spacing=spacing,
        masks=masks,
        initial=torch.from_numpy(colors),
        slab=0.5 * step,
    )
    return fitted.cpu().numpy(), {"polished": True, "spacing": spacing, **report}


_SIGMA = 0.55  # standard deviation of a footprint over the spacing of the Gaussians
_CUT = 2.5  # standard deviations
_LEAST = 0.35  # weight below which a pixel shows too little to count
_STORED = 40_000_000  # matrix entries kept (about 0.6 GB); beyond they are made anew each time


@dataclass(frozen=True)
class SlicePlane:
    """Orthographic view of a cut.

    Attributes:
        center: Middle of the picture, world units [3].
        right: Unit vector along a row [3].
        down: Unit vector along a column [3].
        shape: Height and width [pixels].
        pitch: Edge of a pixel, world units; at most the spacing of the Gaussians.
    """

    center: Tensor
    right: Tensor
    down: Tensor
    shape: tuple[int, int]
    pitch: float


def stack_planes(
    axis: int, offsets: Sequence[int], shape: Sequence[int], origin: Tensor, voxel: float
) -> list[SlicePlane]:
    """Planes through the voxel centres of slices of a volume; rows of a picture come first.

    Slices ``offsets`` lie across ``axis``; ``origin`` is the corner of voxel (0, 0, 0), world
    units.
    """
    down_axis, right_axis = (i for i in range(3) if i != axis)
    unit = torch.eye(3, dtype=origin.dtype, device=origin.device)
    planes = []
    for k in offsets:
        center = origin.clone()
        center[axis] += (k + 0.5) * voxel
        center[down_axis] += 0.5 * shape[down_axis] * voxel
        center[right_axis] += 0.5 * shape[right_axis] * voxel
        size = (int(shape[down_axis]), int(shape[right_axis]))
        planes.append(SlicePlane(center, unit[right_axis], unit[down_axis], size, voxel))
    return planes


class SlabRenderer:
    """The linear map from colours of Gaussians to slices, and its adjoint.

    Weights are exp(-|P(x - p)|^2 / 2 s_p^2 - (n (x - o))^2 / 2 s_n^2), cut at 2.5 standard
    deviations and normalised per pixel; Gaussians count with their centres and one common size.

    Args:
        means: Centres [N, 3], world units.
        planes: Slices.
        spacing: Distance between neighbouring Gaussians, world units.
        slab: Standard deviation off the plane, world units; None takes 0.55 spacings. Half the
            distance of the slices, where they are farther apart than the Gaussians.
    """

    def __init__(
        self,
        means: Tensor,
        planes: Sequence[SlicePlane],
        spacing: float,
        slab: float | None = None,
    ) -> None:
        self.means = means.float()
        self.planes = list(planes)
        self.sigma = _SIGMA * spacing
        self.slab = self.sigma if slab is None else max(slab, self.sigma)
        self._kept: dict[int, tuple[Tensor, Tensor, Tensor, Tensor]] = {}
        self._entries = 0
        self.counted = [self._matrices(k)[3] for k in range(len(self.planes))]

    def _matrices(self, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gaussians of plane k [m], A [P, m], its transpose, and the pixels that count [P]."""
        if k in self._kept:
            return self._kept[k]
        plane = self.planes[k]
        height, width = plane.shape
        normal = torch.linalg.cross(plane.right, plane.down).float()
        relative = self.means - plane.center.float()
        off = relative @ normal
        chosen = (off.abs() < _CUT * self.slab).nonzero()[:, 0]
        column = relative[chosen] @ plane.right.float() / plane.pitch + 0.5 * width - 0.5
        row = relative[chosen] @ plane.down.float() / plane.pitch + 0.5 * height - 0.5
        sigma = self.sigma / plane.pitch
        reach = max(1, math.ceil(_CUT * sigma))
        window = torch.arange(-reach, reach + 1, device=self.means.device)
        rows = row.round().long()[:, None] + window
        columns = column.round().long()[:, None] + window
        along_row = _footprint(rows - row[:, None], sigma) * ((rows >= 0) & (rows < height))
        along_column = _footprint(columns - column[:, None], sigma)
        along_column = along_column * ((columns >= 0) & (columns < width))
        across = torch.exp(-0.5 * (off[chosen] / self.slab) ** 2)
        weight = (across[:, None] * along_row)[:, :, None] * along_column[:, None]
        pixel = rows.clamp(0, height - 1)[:, :, None] * width
        pixel = (pixel + columns.clamp(0, width - 1)[:, None]).flatten()
        owner = torch.arange(len(chosen), device=pixel.device)
        owner = owner.repeat_interleave(len(window) ** 2)
        flat = weight.flatten()
        used = flat > 0
        pixel, owner, flat = pixel[used], owner[used], flat[used]
        total = torch.zeros(height * width, device=flat.device).index_add_(0, pixel, flat)
        counted = total > _LEAST
        flat = flat * (counted / total.clamp(min=1e-9))[pixel]
        order = torch.argsort(pixel, stable=True)
        size = (height * width, len(chosen))
        forward = _csr(pixel[order], owner[order], flat[order], size)
        backward = _csr(owner, pixel, flat, size[::-1])
        made = (chosen, forward, backward, counted)
        if self._entries + len(flat) <= _STORED:
            self._entries += len(flat)
            self._kept[k] = made
        return made

    def render(self, colors: Tensor) -> list[Tensor]:
        """Slices [P, C] of colours [N, C]; pixels that do not count are zero."""
        made = []
        for k in range(len(self.planes)):
            chosen, forward, _, _ = self._matrices(k)
            made.append(forward @ colors[chosen])
        return made

    def adjoint(self, slices: Sequence[Tensor]) -> Tensor:
        """Sum [N, C] of the slices' pixels [P, C], each weighted as it shows the Gaussian."""
        total = torch.zeros(
            len(self.means), slices[0].shape[1], dtype=torch.float32, device=self.means.device
        )
        for k, picture in enumerate(slices):
            chosen, _, backward, _ = self._matrices(k)
            total.index_add_(0, chosen, backward @ picture)
        return total


def _footprint(offset: Tensor, sigma: float) -> Tensor:
    return torch.exp(-0.5 * (offset / sigma) ** 2) * (offset.abs() <= _CUT * sigma)


def _csr(rows: Tensor, columns: Tensor, values: Tensor, size: tuple[int, int]) -> Tensor:
    """Sparse matrix of entries sorted by row."""
    import warnings

    count = torch.bincount(rows, minlength=size[0])
    start = torch.zeros(size[0] + 1, dtype=torch.int32, device=rows.device)
    start[1:] = count.cumsum(0).int()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torch calls its sparse layout a beta
        return torch.sparse_csr_tensor(start, columns.int(), values, size)


def fuse_colors(
    means: Tensor,
    planes: Sequence[SlicePlane],
    targets: Sequence[Tensor],
    *,
    spacing: float,
    masks: Sequence[Tensor] | None = None,
    initial: Tensor | None = None,
    fixed: Tensor | None = None,
    iterations: int = 4,
    prior: float = 0.0,
    slab: float | None = None,
) -> tuple[Tensor, dict[str, Any]]:
    """Colours of Gaussians that show the slices.

    Args:
        means: Centres [N, 3].
        planes: Slices.
        targets: Their pictures, float [H, W, 3] in 0..1.
        spacing: Distance between neighbouring Gaussians, world units.
        masks: Pixels that count, bool [H, W] each; None: all that show enough Gaussians.
        initial: Colours [N, 3] of Gaussians that no slice shows, and of the fixed ones.
        fixed: Gaussians whose colour stays (the surface), bool [N].
        iterations: Conjugate-gradient steps after the vote; 0 is the vote alone.
        prior: Weight that keeps the colours near the vote.
        slab: Half-thickness of the slices; see :class:`SlabRenderer`.

    Returns:
        Colours [N, 3] in 0..1, and the report: rms_before and rms_after (slices against targets),
        iterations, unseen (Gaussians that no slice shows).

    Raises:
        ValueError: Numbers of planes, targets and masks differ, or fixed ones have no colours.
    """
    if len(planes) != len(targets) or (masks is not None and len(masks) != len(planes)):
        raise ValueError(f"{len(planes)} planes for {len(targets)} targets")
    if fixed is not None and initial is None:
        raise ValueError("fixed Gaussians need their colours in initial")
    device = means.device
    renderer = SlabRenderer(means, planes, spacing, slab)
    valid = []
    for k, counted in enumerate(renderer.counted):
        chosen = counted if masks is None else counted & masks[k].to(device).flatten()
        valid.append(chosen.float()[:, None])
    aim = [
        t.to(device, torch.float32).reshape(-1, 3) * v for t, v in zip(targets, valid, strict=True)
    ]
    share = renderer.adjoint(valid)
    seen = share[:, 0] > 1e-4
    start = torch.full((len(means), 3), 0.5, device=device)
    if initial is not None:
        start = initial.to(device, torch.float32).clone()
    free = seen if fixed is None else seen & ~fixed.to(device)
    vote = renderer.adjoint(aim) / share.clamp(min=1e-4)
    colors = torch.where(free[:, None], vote, start)
    loose = free.float()[:, None]

    def residual(now: Tensor) -> list[Tensor]:
        shown = renderer.render(now)
        return [a - s * v for a, s, v in zip(aim, shown, valid, strict=True)]

    pixels = max(float(sum(v.sum() for v in valid)), 1.0)
    rest = residual(colors)
    before = math.sqrt(float(sum((r**2).sum() for r in rest)) / (3 * pixels))
    anchor = colors.clone()
    gradient = renderer.adjoint(rest) * loose
    direction = gradient.clone()
    energy = (gradient**2).sum(0)
    for _ in range(iterations):
        shown = [s * v for s, v in zip(renderer.render(direction), valid, strict=True)]
        curvature = torch.stack([(s**2).sum(0) for s in shown]).sum(0)
        curvature = curvature + prior * (direction**2).sum(0)
        rate = energy / curvature.clamp(min=1e-20)
        colors = colors + rate * direction
        rest = [r - rate * s for r, s in zip(rest, shown, strict=True)]
        gradient = (renderer.adjoint(rest) - prior * (colors - anchor)) * loose
        following = (gradient**2).sum(0)
        direction = gradient + following / energy.clamp(min=1e-20) * direction
        energy = following
    clipped = torch.where(free[:, None], colors.clamp(0.0, 1.0), start)
    after = math.sqrt(float(sum((r**2).sum() for r in residual(clipped))) / (3 * pixels))
    return clipped, {
        "rms_before": before,
        "rms_after": after,
        "iterations": iterations,
        "unseen": int((~seen).sum()),
    }
