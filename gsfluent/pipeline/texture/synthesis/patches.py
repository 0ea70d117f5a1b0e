"""Guided patch synthesis of a solid texture from photographs.

After Kopf et al. 2007 (solid texture synthesis from 2-D exemplars), with two changes that matter:
patches are matched together with their place in the object (depth below the surface, ...), so rind
meets rind; and all patches of the photographs are used about equally often (:mod:`.bank`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent import ops
from gsfluent.colors import lab100_to_rgb, rgb_to_lab100
from gsfluent.pipeline.texture.synthesis.bank import Bank, LevelPhoto
from gsfluent.pipeline.texture.synthesis.levels import hashed, nearest_inside
from gsfluent.pipeline.texture.synthesis.transport import match_near, polish_patches

logger = logging.getLogger(__name__)

_FALLOFF = 0.45  # vote window: standard deviation over half the patch width
_ALONE = 0.3  # of the median squared distance
_CHUNK = 1 << 17  # patches gathered at once


@dataclass(frozen=True)
class Schedule:
    """How much work to spend.

    Attributes:
        iterations: Rounds of voting at the coarsest level, at those between, and at the finest.
        polish: Rounds of patch statistics at the end of a level, likewise.
        bank: Patches of the photographs kept per axis and level.
        samples: Queries that the transport weights are estimated from.
        sinkhorn: Steps of that estimate.
        stride: Distance between patch centres within a slice [voxels].
        patch: Edge of a patch that votes [voxels], odd.
    """

    iterations: tuple[int, int, int] = (6, 4, 2)
    polish: tuple[int, int, int] = (8, 8, 4)
    bank: int = 3072
    samples: int = 640
    sinkhorn: int = 3
    stride: int = 3
    patch: int = 5

    def at(self, level: int, levels: int) -> tuple[int, int]:
        """Rounds of voting and of patch statistics at a level (0 is the coarsest).

        A coarse level gets the same work whatever follows, so that it comes out the same at every
        resolution.
        """
        which = 0 if level == 0 else 2 if level == levels - 1 else 1
        return self.iterations[which], self.polish[which]


@dataclass
class SynthesisLevel:
    """One pyramid level.

    Attributes:
        volume: Lab / 100, [3, X, Y, Z]; updated by :func:`synthesize_level`.
        inside: Voxels to synthesise, bool [X, Y, Z].
        fixed: Voxels whose colour stays, bool [X, Y, Z].
        guide: Guide values [G, X, Y, Z].
        banks: Patches per slice axis.
        reference: Colours [m, 3] and guide values [m, G] of the photographs' pixels; None
            leaves the colours to the patches.
        first: Cell of the object's lattice that is cell (0, 0, 0) here.
        along: Standard deviation [voxels] of a smoothing along the third axis (fibres).
    """

    volume: Tensor
    inside: Tensor
    fixed: Tensor
    guide: Tensor
    banks: dict[int, Bank]
    reference: tuple[Tensor, Tensor] | None
    first: tuple[int, int, int] = (0, 0, 0)
    along: float = 0.0


def synthesize_level(
    level: SynthesisLevel,
    schedule: Schedule,
    rounds: tuple[int, int],
    *,
    transport_last_only: bool = False,
    rng: np.random.Generator,
) -> float:
    """Improve one level in place, in rounds of voting and of patch statistics.

    ``transport_last_only`` moves colours only in the last round (unlayered materials).

    Returns:
        Root mean square over voxels of the disagreement between the axes' proposals in the last
        round: it falls as the three directions settle on one volume. One voxel has one colour, so
        that what disagrees is opinions, never slices.
    """
    # a rim of empty cells, so that no patch reaches beyond the array
    pad = schedule.patch // 2 + 2
    rim = (pad,) * 6
    inside = functional.pad(level.inside, rim)
    shape = inside.shape
    volume = functional.pad(level.volume, rim).reshape(3, -1).T.contiguous()
    flat = inside.reshape(-1).nonzero()[:, 0]
    guide = functional.pad(level.guide, rim).reshape(len(level.guide), -1)[:, flat].T.contiguous()
    fixed = functional.pad(level.fixed, rim).reshape(-1)[flat]
    kept = volume[flat[fixed]].clone()
    target, source = nearest_inside(inside, pad - 1)
    coordinates = torch.stack(
        [flat // (shape[1] * shape[2]), flat // shape[2] % shape[1], flat % shape[2]], 1
    )
    # counted from the object's centre, so that another grid draws the same places
    coordinates = coordinates + torch.tensor(level.first, device=flat.device) - pad
    disagreement = 0.0
    for iteration in range(rounds[0]):
        volume[target] = volume[source]
        total = torch.zeros_like(volume)
        weight = volume.new_zeros(len(volume))
        square = volume.new_zeros(len(volume))
        for axis, bank in level.banks.items():
            votes, share = _axis_votes(
                volume, flat, coordinates, guide, axis, shape, bank, schedule, rng
            )
            total += votes
            weight += share
            # each axis' own opinion, for the agreement figure
            square += (votes**2).sum(1) / share.clamp(min=1e-9)
        voted = weight[flat] > 0
        mean = total[flat] / weight[flat].clamp(min=1e-9)[:, None]
        variance = square[flat] / weight[flat].clamp(min=1e-9) - (mean**2).sum(1)
        disagreement = float((variance[voted].clamp(min=0).mean() / 3).sqrt())
        colors = torch.where(voted[:, None], mean, volume[flat])
        last = iteration == rounds[0] - 1
        if level.reference is not None and (last or not transport_last_only):
            colors = match_near(colors, guide, *level.reference, rng)
        volume[flat] = colors
        if level.along > 0:
            volume = _smoothed_along(volume, inside, level.along)
        volume[flat[fixed]] = kept
    if rounds[1]:
        volume[target] = volume[source]
        grid = volume.T.reshape(3, *shape)
        grid = _polished(level, grid, inside, functional.pad(level.fixed, rim), rim, rounds[1], rng)
        volume = grid.reshape(3, -1).T.contiguous()
        if level.along > 0:
            volume = _smoothed_along(volume, inside, level.along)
        if level.reference is not None:
            volume[flat] = match_near(volume[flat], guide, *level.reference, rng)
        volume[flat[fixed]] = kept
    inner = slice(pad, -pad)
    grid = volume.T.reshape(3, *shape)
    level.volume = grid[:, inner, inner, inner] * level.inside
    return disagreement


def _smoothed_along(volume: Tensor, inside: Tensor, sigma: float) -> Tensor:
    """Volume [V, 3] blurred along the third axis, by inside voxels only."""
    reach = max(1, int(2.5 * sigma))
    line = torch.arange(-reach, reach + 1, device=volume.device).float()
    kernel = torch.exp(-0.5 * (line / sigma) ** 2).reshape(1, 1, -1)
    share = inside.float()
    values = torch.cat([volume.T.reshape(3, *inside.shape) * share, share[None]])
    lines = values.reshape(4, -1, inside.shape[2]).movedim(0, 1).reshape(-1, 1, inside.shape[2])
    blurred = functional.conv1d(lines, kernel, padding=reach)
    blurred = blurred.reshape(-1, 4, inside.shape[2]).movedim(1, 0).reshape(4, -1)
    smooth = (blurred[:3] / blurred[3].clamp(min=1e-6)).T
    return torch.where(inside.reshape(-1, 1), smooth, volume)


def _polished(
    level: SynthesisLevel,
    volume: Tensor,
    inside: Tensor,
    fixed: Tensor,
    rim: tuple[int, ...],
    rounds: int,
    rng: np.random.Generator,
) -> Tensor:
    """Patch statistics matched (:func:`polish_patches`)."""
    whole, banks = {}, {}
    outside = (~inside).float()[None, None]
    for axis, bank in level.banks.items():
        edge = round((bank.whole.shape[1] / 3) ** 0.5)
        window = [edge] * 3
        window[axis] = 1
        reach = [w // 2 for w in window]
        touched = functional.max_pool3d(outside, window, 1, reach)[0, 0]
        whole[axis] = inside & (touched == 0)
        banks[axis] = (bank.whole, bank.guide)
    guide = functional.pad(level.guide, rim)
    return polish_patches(volume, whole, guide, banks, inside & ~fixed, rng, rounds=rounds)


def _axis_votes(
    volume: Tensor,
    flat: Tensor,
    coordinates: Tensor,
    guide: Tensor,
    axis: int,
    shape: torch.Size,
    bank: Bank,
    schedule: Schedule,
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Weighted patch votes [V, 3] and weights [V] of the slices across one axis."""
    strides = (shape[1] * shape[2], shape[2], 1)
    rows, columns = (i for i in range(3) if i != axis)
    stride = schedule.stride
    # staggered from slice to slice, so that neighbours do not share patch borders
    shift = rng.integers(0, stride, 2)
    along = coordinates[:, axis]
    chosen = (coordinates[:, rows] + along + int(shift[0])) % stride == 0
    chosen &= (coordinates[:, columns] + 2 * along + int(shift[1])) % stride == 0
    picked = chosen.nonzero()[:, 0]
    half = schedule.patch // 2
    window = torch.arange(-half, half + 1, device=volume.device)
    offset = (window[:, None] * strides[rows] + window[None] * strides[columns]).reshape(-1)

    def describe(which: Tensor) -> Tensor:
        return bank.describe(volume[flat[which][:, None] + offset], guide[which])

    salt = int(rng.integers(1 << 31))
    total = volume.new_zeros(volume.shape)
    share = volume.new_zeros(len(volume))
    if len(picked) == 0:
        return total, share
    x, y, z = coordinates[picked].unbind(1)
    order = hashed(x, y, z, salt).argsort(stable=True)
    query = describe(picked[order[: schedule.samples]])
    bank.balance(query, schedule.sinkhorn)
    # a patch that fits perfectly must not be alone: the lattice of centres would show
    floor = _ALONE * float(bank.nearest(query)[1].median()) + 1e-4
    gauss = torch.exp(-0.5 * (window.float() / (_FALLOFF * half)) ** 2)
    falloff = (gauss[:, None] * gauss[None]).reshape(-1)
    for part in picked.split(_CHUNK):
        best, distance = bank.nearest(describe(part))
        weight = 1.0 / (distance + floor)
        ops.patch_votes(flat[part], offset, best, bank.patches, weight, falloff, total, share)
    return total, share


def project_slice(
    image: np.ndarray,
    inside: np.ndarray,
    fixed: np.ndarray,
    guide: np.ndarray,
    photo: tuple[np.ndarray, np.ndarray, np.ndarray],
    schedule: Schedule,
    iterations: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Patch synthesis in a single slice, by itself; the photograph also turned and mirrored.

    Args:
        image: RGB in 0..1, [H, W, 3].
        inside: Pixels of the object, bool [H, W].
        fixed: Pixels that stay, bool [H, W].
        guide: Guide value per pixel, [H, W].
        photo: Photograph at the same pitch: image [h, w, 3], mask [h, w], guide [h, w].
        schedule: Work settings.
        iterations: Rounds of voting.
        rng: Random generator.

    Returns:
        RGB [H, W, 3]; pixels that are fixed or outside are those of ``image``.
    """
    within = torch.from_numpy(inside[None])
    place = torch.from_numpy(guide.astype(np.float32)[None, None])
    shown = LevelPhoto(
        rgb_to_lab100(torch.from_numpy(photo[0].astype(np.float32))),
        torch.from_numpy(photo[1]),
        torch.from_numpy(photo[2].astype(np.float32)[..., None]),
    )
    target = place[0][within][:, None]
    wanted = min(schedule.bank, max(512, int(inside.sum()) // schedule.stride**2))
    bank = Bank([shown], wanted, schedule.patch, schedule.patch, True, target, rng)
    lab = rgb_to_lab100(torch.from_numpy(image.astype(np.float32))).movedim(-1, 0)
    level = SynthesisLevel(
        lab[:, None], within, torch.from_numpy(fixed[None]), place, {0: bank}, None
    )
    synthesize_level(level, schedule, (iterations, 0), rng=rng)
    made = lab100_to_rgb(level.volume[:, 0].movedim(0, -1)).numpy()
    return np.where((inside & ~fixed)[..., None], made, image).astype(np.float32)
