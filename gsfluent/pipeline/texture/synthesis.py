"""Guided patch synthesis of a solid texture from one photograph.

After Kopf et al. 2007 (solid texture synthesis from 2-D exemplars), with two changes that matter:
patches are matched together with their depth below the surface, so rind meets rind; and the nearest
patch is searched under the dual weights of a semi-discrete optimal transport, so that every patch
of the photograph is used about equally often. Without the weights a few smooth patches win
everywhere and the material washes out.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .photo import Exemplar
from .profile import match_colors

__all__ = ["Schedule", "SynthesisLevel", "synthesize_level"]

logger = logging.getLogger(__name__)

_DIMENSIONS = 24  # principal components of a patch that are compared
_FALLOFF = 0.45  # vote window: standard deviation over half the patch width
_QUERY_CHUNK = 4096


@dataclass(frozen=True)
class Schedule:
    """How much work to spend.

    Attributes:
        iterations: Rounds per pyramid level, coarse to fine.
        bank: Patches of the photograph kept per level.
        samples: Queries that the transport weights are estimated from.
        sinkhorn: Steps of that estimate.
        stride: Distance between patch centres within a slice [voxels].
        patch: Edge of a patch [voxels], odd.
    """

    iterations: tuple[int, ...] = (6, 4, 2)
    bank: int = 3072
    samples: int = 640
    sinkhorn: int = 3
    stride: int = 3
    patch: int = 5


@dataclass
class SynthesisLevel:
    """One pyramid level.

    Attributes:
        rgb: Volume, float32 [X, Y, Z, 3]; updated by :func:`synthesize_level`.
        inside: Voxels to synthesise, bool [X, Y, Z].
        fixed: Voxels whose colour stays, bool [X, Y, Z].
        guide: Guide values per voxel, float32 [X, Y, Z, G], already weighted; the first one grows
            with depth (zeros when there is no guide).
        exemplars: Photograph per axis, at this level's pitch, with its guide image [H, W, G].
        depth: Depth [voxels of this level] for the colour transport; None without a guide.
    """

    rgb: np.ndarray
    inside: np.ndarray
    fixed: np.ndarray
    guide: np.ndarray
    exemplars: dict[int, tuple[Exemplar, np.ndarray]]
    depth: np.ndarray | None


class _Bank:
    """Patches of one photograph with their descriptors."""

    def __init__(
        self,
        exemplar: Exemplar,
        guide: np.ndarray,
        schedule: Schedule,
        turns: bool,
        queries: int,
        rng: np.random.Generator,
    ) -> None:
        half = schedule.patch // 2
        size = schedule.patch
        image = np.pad(exemplar.image, ((half, half), (half, half), (0, 0)), mode="edge")
        rows, columns = np.nonzero(exemplar.mask)
        # more patches than queries cannot all be used
        wanted = min(schedule.bank, max(512, queries))
        pick = rng.permutation(len(rows))
        # a small photograph gives each patch several times, each time turned differently
        pick = np.resize(pick, wanted) if len(pick) * 8 > wanted else np.tile(pick, 8)
        rows, columns = rows[pick], columns[pick]
        window = np.arange(size)
        patches = image[rows[:, None, None] + window[:, None], columns[:, None, None] + window]
        if turns:
            turn = rng.integers(0, 8, len(patches))
            for k in range(8):
                chosen = turn == k
                turned = np.rot90(patches[chosen], k % 4, axes=(1, 2))
                patches[chosen] = turned[:, :, ::-1] if k >= 4 else turned
        self.patches = torch.from_numpy(patches.reshape(len(patches), -1).astype(np.float32))
        self.mean = self.patches.mean(0)
        centered = self.patches - self.mean
        covariance = centered.T @ centered / max(len(centered), 1)
        _, vectors = torch.linalg.eigh(covariance)
        self.basis = vectors[:, -_DIMENSIONS:]
        self.guide = torch.from_numpy(guide[rows, columns].astype(np.float32))
        self.descriptor = torch.cat([centered @ self.basis, self.guide], 1)
        self.norm = (self.descriptor**2).sum(1)
        layer = self.guide[:, 0]
        order = layer.argsort()
        bins = 12 if float(layer.std()) > 1e-6 else 1
        self.bin = torch.empty(len(order), dtype=torch.long)
        self.bin[order] = torch.arange(len(order)) * bins // len(order)
        self.bins = bins
        starts = torch.arange(bins) * len(order) // bins
        self.edges = layer[order][starts[1:]].contiguous()
        self.dual = torch.zeros(len(order))

    def describe(self, patches: Tensor, guide: Tensor) -> Tensor:
        """Descriptors [n, 24 + G] of patches [n, P] with guide values [n, G]."""
        return torch.cat([(patches - self.mean) @ self.basis, guide], 1)

    def balance(self, query: Tensor, steps: int) -> None:
        """Estimate the dual weights so that patches of a depth bin share its queries equally.

        Sinkhorn steps on the sampled cost matrix; only the exemplar side is enforced, because
        every query takes exactly one patch anyway.
        """
        cost = (self.norm - 2 * query @ self.descriptor.T).add_((query**2).sum(1)[:, None])
        cost.clamp_(min=0)
        nearest = cost.min(1).values
        softness = float(nearest.median()) * 0.5 + 1e-4
        share = torch.bincount(
            torch.bucketize(query[:, self.basis.shape[1]].contiguous(), self.edges),
            minlength=self.bins,
        ).float()
        population = torch.bincount(self.bin, minlength=self.bins).float()
        target = ((share + 0.5) / (share + 0.5).sum() / population)[self.bin]
        dual = torch.zeros(len(self.norm))
        for _ in range(steps):
            usage = torch.softmax((dual - cost) / softness, dim=1).mean(0)
            dual -= softness * torch.log((usage + 1e-9) / target)
        # far outside the cost scale a weight would override likeness altogether
        spread = 3.0 * float(nearest.mean()) + 1e-4
        self.dual = (dual - dual.mean()).clamp_(-spread, spread)

    def nearest(self, query: Tensor) -> tuple[Tensor, Tensor]:
        """Best patch [n] under the weights, and its plain squared distance [n]."""
        best = torch.empty(len(query), dtype=torch.long)
        offset = self.norm - self.dual
        for start in range(0, len(query), _QUERY_CHUNK):
            part = query[start : start + _QUERY_CHUNK]
            score = torch.addmm(offset, part, self.descriptor.T, alpha=-2.0)
            best[start : start + _QUERY_CHUNK] = score.argmin(1)
        distance = ((query - self.descriptor[best]) ** 2).sum(1)
        return best, distance


def synthesize_level(
    level: SynthesisLevel,
    schedule: Schedule,
    iterations: int,
    *,
    axes: tuple[int, ...] = (0, 1, 2),
    turns: bool = True,
    transport_bins: int = 10,
    transport_last_only: bool = False,
    rng: np.random.Generator,
) -> float:
    """Improve one level in place.

    Args:
        level: Volume, masks, guide and photographs.
        schedule: Work settings.
        iterations: Rounds.
        axes: Slice directions that take part.
        turns: Use the photograph turned and mirrored (off for grained materials).
        transport_bins: Depth ranges of the colour transport.
        transport_last_only: Transport colours only in the last round (unlayered materials).
        rng: Random generator.

    Returns:
        Root mean square over voxels of the disagreement between the axes' proposals in the last
        round: it falls as the three directions settle on one volume.
    """
    pad = schedule.patch // 2 + 1
    shape = tuple(s + 2 * pad for s in level.inside.shape)
    strides = (shape[1] * shape[2], shape[2], 1)
    padded = np.pad(level.inside, pad)
    volume = torch.from_numpy(
        np.pad(level.rgb, ((pad, pad),) * 3 + ((0, 0),)).reshape(-1, 3).astype(np.float32)
    )
    target, source = _extension(padded, pad)
    queries = int(level.inside.sum()) // schedule.stride**2
    banks = {
        axis: _Bank(*level.exemplars[axis], schedule, turns, queries, rng)
        for axis in axes
        if axis in level.exemplars
    }
    coordinates = torch.from_numpy(np.argwhere(padded))
    flat = coordinates @ torch.tensor(strides)
    guide = torch.from_numpy(level.guide[level.inside].astype(np.float32))
    fixed = torch.from_numpy(np.pad(level.fixed, pad).reshape(-1)[flat.numpy()])
    kept = volume[flat[fixed]].clone()
    reference = level.exemplars[axes[0]][0]
    disagreement = 0.0
    for iteration in range(iterations):
        volume[target] = volume[source]
        total = torch.zeros_like(volume)
        weight = torch.zeros(len(volume))
        square = torch.zeros(len(volume))
        for axis, bank in banks.items():
            votes, share = _axis_votes(
                volume, flat, coordinates, guide, axis, strides, bank, schedule, rng
            )
            total += votes
            weight += share
            # each axis' own opinion, for the agreement figure
            opinion = votes[flat] / share[flat].clamp(min=1e-9)[:, None]
            square[flat] += share[flat] * (opinion**2).sum(1)
        voted = weight[flat] > 0
        mean = total[flat] / weight[flat].clamp(min=1e-9)[:, None]
        variance = square[flat] / weight[flat].clamp(min=1e-9) - (mean**2).sum(1)
        disagreement = float((variance[voted].clamp(min=0).mean() / 3).sqrt())
        rgb = torch.where(voted[:, None], mean, volume[flat])
        if transport_bins > 0 and (not transport_last_only or iteration == iterations - 1):
            values = rgb.numpy()
            depth = (
                np.zeros(len(values))
                if level.depth is None
                else level.depth[level.inside].astype(np.float64)
            )
            moved = match_colors(
                values,
                depth,
                reference.image[reference.mask],
                np.zeros(int(reference.mask.sum()))
                if level.depth is None
                else reference.depth[reference.mask],
                bins=transport_bins if level.depth is not None else 1,
                rng=rng,
                rounds=2,
            )
            rgb = torch.from_numpy(moved)
        volume[flat] = rgb
        volume[flat[fixed]] = kept
    level.rgb[level.inside] = volume[flat].numpy()
    return disagreement


def _axis_votes(
    volume: Tensor,
    flat: Tensor,
    coordinates: Tensor,
    guide: Tensor,
    axis: int,
    strides: tuple[int, int, int],
    bank: _Bank,
    schedule: Schedule,
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Weighted patch votes [V, 3] and weights [V] of the slices across one axis."""
    rows, columns = (i for i in range(3) if i != axis)
    stride = schedule.stride
    # staggered from slice to slice, so that neighbours do not share patch borders
    shift = rng.integers(0, stride, 2)
    along = coordinates[:, axis]
    chosen = (coordinates[:, rows] + along + int(shift[0])) % stride == 0
    chosen &= (coordinates[:, columns] + 2 * along + int(shift[1])) % stride == 0
    center = flat[chosen]
    half = schedule.patch // 2
    window = torch.arange(-half, half + 1)
    offset = (window[:, None] * strides[rows] + window[None] * strides[columns]).reshape(-1)
    index = center[:, None] + offset[None]
    patches = volume[index].reshape(len(center), -1)
    query = bank.describe(patches, guide[chosen])
    sample = torch.from_numpy(rng.integers(0, len(query), min(schedule.samples, len(query))))
    bank.balance(query[sample], schedule.sinkhorn)
    best, distance = bank.nearest(query)
    gauss = torch.exp(-0.5 * (window.float() / (_FALLOFF * half)) ** 2)
    falloff = (gauss[:, None] * gauss[None]).reshape(-1)
    weight = falloff[None] / (distance[:, None] + 1e-4)
    proposal = bank.patches[best].view(len(center), -1, 3) * weight[..., None]
    total = torch.zeros_like(volume)
    total.index_add_(0, index.reshape(-1), proposal.reshape(-1, 3))
    share = torch.zeros(len(volume))
    share.index_add_(0, index.reshape(-1), weight.reshape(-1))
    return total, share


def _extension(padded: np.ndarray, reach: int) -> tuple[Tensor, Tensor]:
    """Flat indices of voxels just outside and of the inside voxel nearest to each."""
    from scipy import ndimage

    distance, nearest = ndimage.distance_transform_edt(~padded, return_indices=True)
    near = (distance > 0) & (distance <= reach * 1.5)
    target = np.flatnonzero(near.reshape(-1))
    source = np.ravel_multi_index(tuple(nearest[:, near]), padded.shape)
    return torch.from_numpy(target), torch.from_numpy(source)
