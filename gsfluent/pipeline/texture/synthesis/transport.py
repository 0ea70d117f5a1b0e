"""Distributions moved to the photographs': of colours, and of whole patches, near each guide value.

Both are sliced optimal transport (Pitie et al. 2005; Rabin et al. 2011): along a direction two
distributions are matched by their quantiles. "Near each guide value" is a random partition of the
guide's space, new in every round, so that no border between two parts can be seen.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.geometry import ascending

_KNOTS = 65
_COLOR_PARTS, _PARTITIONS, _ROTATIONS = 12, 3, 2  # parts of the guide's space for colours
_PATCH_PARTS, _FILTERS = 6, 8  # the same for patches; directions per round and axis
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


def _quantiles(values: Tensor, rng: np.random.Generator, limit: int = 4096) -> Tensor:
    """Quantiles [K, D] of values [n, D], estimated from at most ``limit`` of them."""
    if len(values) > limit:
        pick = torch.from_numpy((rng.random(limit) * len(values)).astype(np.int64))
        pick = pick.to(values.device)
        values = values[pick]
    ordered = ascending(values)
    place = torch.linspace(0, len(ordered) - 1, _KNOTS, device=values.device)
    low = place.floor().long().clamp(max=len(ordered) - 1)
    high = (low + 1).clamp(max=len(ordered) - 1)
    share = (place - low)[:, None]
    return ordered[low] * (1 - share) + ordered[high] * share


def _shift(values: Tensor, have: Tensor, want: Tensor) -> Tensor:
    """How far values [n, D] move when quantiles ``have`` become ``want`` (both [K, D])."""
    knots = have.T.contiguous()
    # equal quantiles (flat colour) would make the inverse ambiguous
    knots = knots + 1e-5 * torch.arange(_KNOTS, device=values.device)
    moves = (want - have).T.contiguous()
    at = values.T.contiguous()
    right = torch.searchsorted(knots, at).clamp_(1, _KNOTS - 1)
    left_knot, right_knot = knots.gather(1, right - 1), knots.gather(1, right)
    share = ((at - left_knot) / (right_knot - left_knot)).clamp_(0.0, 1.0)
    left, last = moves.gather(1, right - 1), moves.gather(1, right)
    return (left + share * (last - left)).T


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
        own, other = cells.of(guide), cells.of(reference_guide)
        moved = values.clone()
        for k in range(len(cells.centers)):
            chosen = (own == k).nonzero()[:, 0]
            source = reference[other == k]
            if len(chosen) < _LEAST or len(source) < _LEAST:
                continue
            part = moved[chosen]
            for _ in range(_ROTATIONS):
                basis = torch.from_numpy(np.linalg.qr(rng.standard_normal((3, 3)))[0]).to(values)
                turned = part @ basis
                have = _quantiles(turned, rng, 16384)
                want = _quantiles(source @ basis, rng, 16384)
                part = part + _shift(turned, have, want) @ basis.T
            moved[chosen] = part
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
            other = cells.of(patch_guide)
            reference = patches @ kernel
            moves = torch.zeros_like(flat)
            for k in range(len(cells.centers)):
                chosen = (own == k).nonzero()[:, 0]
                source = reference[other == k]
                if len(chosen) < _LEAST or len(source) < _LEAST:
                    continue
                part = flat[chosen]
                moves[chosen] = _shift(part, _quantiles(part, rng), _quantiles(source, rng))
            spread = torch.zeros(filters, mask.numel(), device=volume.device)
            spread[:, position] = moves.T
            spread = spread.reshape(filters, *mask.shape).permute(1, 0, 2, 3)
            back = functional.conv2d(spread, weight.flip(2, 3).transpose(0, 1), padding=half)
            # the mean over the patches that hold a voxel, over directions not drawn this time
            gain = 24.0 / filters / edge**2
            allowed = free.movedim(axis, 0)
            first += (gain * back * allowed[:, None]).permute(1, 0, 2, 3)
    return volume
