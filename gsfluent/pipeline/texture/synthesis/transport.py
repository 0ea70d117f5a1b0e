"""Distributions moved to the photographs': of colours, and of whole patches, near each guide value.

Both are sliced optimal transport (Pitie et al. 2005; Rabin et al. 2011): along a direction two
distributions are matched by their quantiles. "Near each guide value" is a random partition of the
guide's space, new in every round, so that no border between two parts can be seen.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent import ops
from gsfluent.geometry import ascending

_KNOTS = 65
_COLOR_PARTS, _PARTITIONS, _ROTATIONS = 12, 3, 2  # parts of the guide's space for colours
_PATCH_PARTS, _FILTERS = 6, 8  # the same for patches; directions per round and axis
_AT_ONCE = {"cpu": 1 << 16}  # values of parts that are worked on together: as the cache is
_AT_ONCE_ELSEWHERE = 1 << 23  # where launches cost more than memory
_LEAST = 96  # samples a part of the guide's space must hold on both sides


class Cells:
    """Random parts of the guide's space.

    Args:
        reference: Guide values of the photographs [m, G].
        count: Parts wanted; 1 or a constant guide gives a single part.
        rng: Random generator.
    """

    def __init__(self, reference: Tensor, count: int, rng: np.random.Generator) -> None:
        picks = rng.random(count)
        flat = bool((reference.std(0, unbiased=False) < 1e-6).all())
        if count <= 1 or flat or len(reference) < 2 * _LEAST:
            self.centers = reference[:1]
        else:
            index = torch.from_numpy((picks * len(reference)).astype(np.int64))
            self.centers = reference[index.to(reference.device)]

    def of(self, guide: Tensor) -> Tensor:
        """Part of each guide value [n, G], int64 [n]."""
        if len(self.centers) == 1:
            return torch.zeros(len(guide), dtype=torch.int64, device=guide.device)
        norm = (self.centers**2).sum(1)
        parts = [
            torch.addmm(norm, part, self.centers.T, alpha=-2.0).argmin(1)
            for part in guide.split(1 << 20)
        ]
        return torch.cat(parts)


@dataclass(frozen=True)
class _Side:
    """Rows of some parts, each part's one after the other.

    Attributes:
        order: Rows by part, int64 [n].
        starts: Where each part begins there.
        sizes: Rows of each part.
    """

    order: Tensor
    starts: list[int]
    sizes: list[int]

    def rows(self, some: slice) -> tuple[Tensor, Tensor]:
        """Rows of parts beside each other, int64 [P, L], and which of them count, bool [P, L].

        Short ones repeat their last row.
        """
        ends = torch.tensor([self.starts[some], self.sizes[some]], device=self.order.device)
        start, size = ends[:, :, None]
        column = torch.arange(max(self.sizes[some]), device=self.order.device)
        return self.order[start + column.minimum(size - 1)], column < size


class _Parts:
    """Rows that belong together, of all parts of the guide's space with enough on both sides.

    Args:
        own: Part of each value, int64 [n].
        other: Part of each sample of the photographs, int64 [m].
        count: Parts.
    """

    def __init__(self, own: Tensor, other: Tensor, count: int) -> None:
        both = [torch.bincount(part, minlength=count) for part in (own, other)]
        sizes = torch.stack(both).tolist()
        enough = [min(pair) >= _LEAST for pair in zip(*sizes, strict=True)]
        self.own, self.other = (
            _Side(
                part.argsort(stable=True),
                list(itertools.compress(itertools.accumulate(each, initial=0), enough)),
                list(itertools.compress(each, enough)),
            )
            for part, each in zip((own, other), sizes, strict=True)
        )

    def together(self, device: torch.device) -> list[slice]:
        """Parts that are worked on in one go."""
        most = _AT_ONCE.get(device.type, _AT_ONCE_ELSEWHERE)
        slices, first, longest = [], 0, 0
        for k, pair in enumerate(zip(self.own.sizes, self.other.sizes, strict=True)):
            size = max(pair)
            if k > first and (k + 1 - first) * max(longest, size) > most:
                slices.append(slice(first, k))
                first, longest = k, 0
            longest = max(longest, size)
        return [*slices, slice(first, len(self.own.sizes))] if self.own.sizes else []


def _drawn(size: int, rng: np.random.Generator, limit: int) -> np.ndarray | None:
    """Which of many values stand for all; None for each of few."""
    return (rng.random(limit) * size).astype(np.int64) if size > limit else None


def _quantiles(values: Tensor, sizes: list[int], picks: Sequence[np.ndarray | None]) -> Tensor:
    """Quantiles [P, K, D] of the values [P, L, D] of each part, or of those picked."""
    device, (parts, length, columns) = values.device, values.shape
    sizes = [n if pick is None else len(pick) for n, pick in zip(sizes, picks, strict=True)]
    last, most = np.array(sizes)[:, None] - 1, max(sizes)
    place = np.minimum(np.arange(most), last) + length * np.arange(parts)[:, None]
    for k, pick in enumerate(picks):
        if pick is not None:
            place[k, : len(pick)] = pick + length * k
    some = values.reshape(-1, columns)[torch.from_numpy(place.reshape(-1)).to(device)]
    some = some.view(parts, most, columns)
    if min(sizes) < most:
        beyond = torch.from_numpy(np.arange(most) > last).to(device)
        some = some.masked_fill(beyond[..., None], math.inf)
    ordered = ascending(some.movedim(1, 0)).movedim(0, 1)
    knots = np.stack([_knots(n) for n in sizes])
    low = np.floor(knots)
    rows = np.stack([low, np.minimum(low + 1, last)]).astype(np.int64)
    before, after = torch.from_numpy(rows).to(device)
    share = torch.from_numpy(knots - low).to(device)
    return ops.rows_between(ordered, before, after, share)


@functools.lru_cache(maxsize=1024)
def _knots(size: int) -> np.ndarray:
    """Places of the quantiles among so many ordered values, float32 [K]."""
    return torch.linspace(0, size - 1, _KNOTS).numpy()


def match_near(
    values: Tensor,
    guide: Tensor,
    reference: Tensor,
    reference_guide: Tensor,
    rng: np.random.Generator,
) -> Tensor:
    """Move colours [n, 3] to the photographs' distribution [m, 3] at like guide values, [., G].

    Mean over several partitions of the guide's space, of several rotations each.
    """
    total = torch.zeros_like(values)
    single = bool((reference_guide.std(0, unbiased=False) < 1e-6).all())
    repeats = 1 if single else _PARTITIONS
    for _ in range(repeats):
        cells = Cells(reference_guide, _COLOR_PARTS, rng)
        parts = _Parts(cells.of(guide), cells.of(reference_guide), len(cells.centers))
        draws = [
            [
                (
                    np.linalg.qr(rng.standard_normal((3, 3)))[0],
                    _drawn(mine, rng, 16384),
                    _drawn(source, rng, 16384),
                )
                for _ in range(_ROTATIONS)
            ]
            for mine, source in zip(parts.own.sizes, parts.other.sizes, strict=True)
        ]
        moved = values.clone()
        for some in parts.together(values.device):
            (rows, there), sources = parts.own.rows(some), parts.other.rows(some)[0]
            part, source = values[rows], reference[sources]
            for drawn in zip(*draws[some], strict=True):
                matrices, own_picks, other_picks = zip(*drawn, strict=True)
                bases = torch.from_numpy(np.stack(matrices)).to(values)
                turned = part @ bases
                have = _quantiles(turned, parts.own.sizes[some], own_picks)
                want = _quantiles(source @ bases, parts.other.sizes[some], other_picks)
                part = part + ops.quantile_shift(turned, have, want) @ bases.mT
            moved[rows[there]] = part[there]
        total += moved
    return total / repeats


def polish_patches(
    volume: Tensor,
    whole: dict[int, Tensor],
    guide: Tensor,
    banks: dict[int, tuple[Tensor, Tensor]],
    free: Tensor,
    rng: np.random.Generator,
    *,
    rounds: int,
) -> Tensor:
    """Let the patches of all slices have the distribution of the photographs' patches.

    One round, per axis: a few random directions of patch space are drawn, the slices are filtered
    with them, the responses are moved to the quantiles of the photographs' responses, and the
    moves are put back into the voxels (the adjoint of the filters).

    Args:
        volume: Colours [3, X, Y, Z], extended a little beyond the inside.
        whole: Per axis, cells whose whole patch lies inside, bool [X, Y, Z].
        guide: Guide values [G, X, Y, Z].
        banks: Per axis, patches [K, E*E*3] of the photographs (rows, columns, colour) and their
            guide values [K, G].
        free: Cells that may change, bool [X, Y, Z].
        rng: Random generator.
        rounds: Rounds.
    """
    volume, filters = volume.clone(), _FILTERS
    bases = {}
    for axis, (patches, _) in banks.items():
        centered = patches - patches.mean(0)
        vectors = torch.linalg.eigh((centered.T @ centered).double())[1]
        bases[axis] = vectors[:, -24:].to(patches)
    for _ in range(rounds):
        for axis, (patches, patch_guide) in banks.items():
            edge = round((patches.shape[1] / 3) ** 0.5)
            half = edge // 2
            mix = np.linalg.qr(rng.standard_normal((24, 24)))[0][:, :filters]
            kernel = bases[axis] @ torch.from_numpy(mix).to(patches)
            weight = kernel.T.reshape(filters, edge, edge, 3).permute(0, 3, 1, 2).contiguous()
            cells = Cells(patch_guide, _PATCH_PARTS, rng)
            first = volume.movedim(axis + 1, 1)
            slices = first.permute(1, 0, 2, 3)
            mask = whole[axis].movedim(axis, 0)
            if not bool(mask.any()):
                continue
            position = mask.reshape(-1).nonzero()[:, 0]
            responses = functional.conv2d(slices, weight, padding=half)
            flat = responses.permute(1, 0, 2, 3).reshape(filters, -1)[:, position].T
            own_guide = guide.movedim(axis + 1, 1).reshape(len(guide), -1)
            own = cells.of(own_guide[:, position].T.contiguous())
            parts = _Parts(own, cells.of(patch_guide), len(cells.centers))
            picks = [
                (_drawn(mine, rng, 4096), _drawn(source, rng, 4096))
                for mine, source in zip(parts.own.sizes, parts.other.sizes, strict=True)
            ]
            reference = patches @ kernel
            moves = torch.zeros_like(flat)
            for some in parts.together(flat.device):
                own_picks, other_picks = zip(*picks[some], strict=True)
                (rows, there), sources = parts.own.rows(some), parts.other.rows(some)[0]
                part = flat[rows]
                have = _quantiles(part, parts.own.sizes[some], own_picks)
                want = _quantiles(reference[sources], parts.other.sizes[some], other_picks)
                moves[rows[there]] = ops.quantile_shift(part, have, want)[there]
            spread = torch.zeros(filters, mask.numel(), device=volume.device)
            spread[:, position] = moves.T
            spread = spread.reshape(filters, *mask.shape).permute(1, 0, 2, 3)
            back = functional.conv2d(spread, weight.flip(2, 3).transpose(0, 1), padding=half)
            # the mean over the patches that hold a voxel, over directions not drawn this time
            gain = 24.0 / filters / edge**2
            allowed = free.movedim(axis, 0)
            first += (gain * back * allowed[:, None]).permute(1, 0, 2, 3)
    return volume
