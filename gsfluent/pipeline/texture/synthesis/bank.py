"""Patches of the photographs, and the search among them that uses all of them.

The nearest patch is searched under the dual weights of a semi-discrete optimal transport, so that
every patch is used about equally often. Without them a few smooth patches win everywhere and the
material washes out.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.pipeline.texture.synthesis.transport import Cells

_DIMENSIONS = 24  # principal components of a patch that are compared
_CHUNK_CELLS = {"cpu": 1 << 21}  # scores held at once: where memory is not fetched anew for them
_CHUNK_CELLS_ELSEWHERE = 1 << 25
_PARTS = 24  # parts of the guide's space whose shares are balanced


@dataclass(frozen=True)
class LevelPhoto:
    """A photograph at the pitch of a level.

    Attributes:
        image: Lab / 100, [U, V, 3]; U and V run along the first and second axis of its plane.
        mask: Pixels of the object, bool [U, V].
        guide: Guide values [U, V, G].
    """

    image: Tensor
    mask: Tensor
    guide: Tensor


class Bank:
    """Patches for one slice axis.

    Args:
        photos: Photographs, pooled.
        wanted: Patches to keep.
        edge: Edge of the stored patches, odd.
        compared: Edge of the patches that are compared and vote, odd, at most ``edge``.
        turns: Also use them turned by quarter turns and mirrored.
        target: Guide values of the voxels to fill [n, G]; patches are drawn so that the bank has
            the same mix of guide values (a solid holds more shallow places than its cut shows).
        rng: Random generator.
    """

    def __init__(
        self,
        photos: Sequence[LevelPhoto],
        wanted: int,
        edge: int,
        compared: int,
        turns: bool,
        target: Tensor,
        rng: np.random.Generator,
    ) -> None:
        drawn = [_draw(photo, 2 * wanted // len(photos) + 1, edge, rng) for photo in photos]
        pool, guide, number = (torch.cat(parts) for parts in zip(*drawn, strict=True))
        device = pool.device
        self.cells = Cells(guide, _PARTS, rng)
        parts = len(self.cells.centers)
        own = self.cells.of(guide)
        population = torch.bincount(own, minlength=parts).float()
        need = torch.bincount(self.cells.of(target), minlength=parts).float()
        need = need / need.sum().clamp(min=1.0)
        ratio = need / (population / population.sum()).clamp(min=1e-9)
        # weighted drawing by a race of exponentials (Efraimidis & Spirakis 2006): a patch's lot is
        # its own, so that a pixel more or less in the picture does not change the others'
        count = min(wanted, len(pool))
        lot = ((number * 2654435761 & 0xFFFFFFFF).double() + 0.5) / 2.0**32
        race = -lot.log() / ratio.clamp(0.2, 5.0)[own].double()
        pick = race.argsort(stable=True)[:count]
        pool, self.guide = pool[pick], guide[pick]
        self.part = own[pick]
        if turns:
            pool = _turned(pool, (number[pick] * 40503 >> 7) % 8)
        self.whole = pool.reshape(count, -1)
        rim = (edge - compared) // 2
        inner = pool[:, rim : edge - rim, rim : edge - rim] if rim else pool
        self.patches = inner.reshape(count, compared * compared, 3).contiguous()
        flat = self.patches.reshape(count, -1)
        self.mean = flat.mean(0)
        centered = flat - self.mean
        vectors = torch.linalg.eigh((centered.T @ centered).double())[1]
        self.basis = vectors[:, -_DIMENSIONS:].to(flat)
        self.descriptor = torch.cat([centered @ self.basis, self.guide], 1)
        self.norm = (self.descriptor**2).sum(1)
        self.dual = torch.zeros(count, device=device)

    def describe(self, patches: Tensor, guide: Tensor) -> Tensor:
        """Descriptors [n, 24 + G] of patches [n, P, 3] with guide values [n, G]."""
        flat = patches.reshape(len(patches), -1)
        return torch.cat([(flat - self.mean) @ self.basis, guide], 1)

    def balance(self, query: Tensor, steps: int) -> None:
        """Estimate the dual weights so that patches of like guide share its queries equally.

        Sinkhorn steps (Cuturi 2013) on the sampled cost matrix; only the exemplar side is
        enforced, because every query takes exactly one patch anyway.
        """
        cost = (self.norm - 2 * query @ self.descriptor.T).add_((query**2).sum(1)[:, None])
        cost.clamp_(min=0)
        nearest = cost.min(1).values
        softness = float(nearest.median()) * 0.5 + 1e-4
        parts = len(self.cells.centers)
        share = torch.bincount(
            self.cells.of(query[:, self.basis.shape[1] :].contiguous()), minlength=parts
        ).float()
        population = torch.bincount(self.part, minlength=parts).float().clamp(min=1.0)
        target = ((share + 0.5) / (share + 0.5).sum() / population)[self.part]
        dual, room = torch.zeros_like(self.norm), torch.empty_like(cost)
        for _ in range(steps):
            torch.sub(dual, cost, out=room)
            usage = torch.softmax(room.div_(softness), dim=1).mean(0)
            dual = dual - softness * torch.log((usage + 1e-9) / target)
        # far outside the cost scale a weight would override likeness altogether
        spread = 3.0 * float(nearest.mean()) + 1e-4
        self.dual = (dual - dual.mean()).clamp_(-spread, spread)

    def nearest(self, query: Tensor) -> tuple[Tensor, Tensor]:
        """Best patch [n] under the weights, and its plain squared distance [n]."""
        offset = self.norm - self.dual
        most = _CHUNK_CELLS.get(offset.device.type, _CHUNK_CELLS_ELSEWHERE)
        rows = max(256, most // len(offset))
        best = torch.cat(
            [
                torch.addmm(offset, part, self.descriptor.T, alpha=-2.0).argmin(1)
                for part in query.split(rows)
            ]
        )
        return best, ((query - self.descriptor[best]) ** 2).sum(1)


def _draw(
    photo: LevelPhoto, count: int, edge: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Patches [n, E, E, 3], their guide values and the number of each place.

    Both hardly depend on the picture's exact pixel count.
    """
    height, width = photo.mask.shape
    # Halton points (Halton 1960) shifted by a random vector: even coverage, few misses
    place = np.stack([_halton(64 * count, 2), _halton(64 * count, 3)], 1)
    place = (place + rng.random(2)) % 1.0
    index = torch.from_numpy(np.floor(place * [height, width]).astype(np.int64))
    index = index.to(photo.mask.device)
    usable = photo.mask[index[:, 0], index[:, 1]].nonzero()[:count, 0]
    index, usable = index[usable], usable + 1
    if len(index) == 0:  # a mask of very few pixels
        index = photo.mask.nonzero()
        usable = torch.arange(1, len(index) + 1, device=index.device)
    half = edge // 2
    image = functional.pad(photo.image.permute(2, 0, 1)[None], (half,) * 4, mode="replicate")[0]
    window = torch.arange(edge, device=image.device)
    rows = index[:, 0, None, None] + window[:, None]
    columns = index[:, 1, None, None] + window
    patches = image[:, rows, columns].permute(1, 2, 3, 0)
    return patches, photo.guide[index[:, 0], index[:, 1]], usable


def _halton(count: int, base: int) -> np.ndarray:
    """Radical inverses of 1 to ``count - 1`` in a base."""
    digits = 0
    while base**digits < count:
        digits += 1
    return _inverses(base, digits)[1:count]


@functools.lru_cache(maxsize=4)
def _inverses(base: int, digits: int) -> np.ndarray:
    """Radical inverses of all numbers of so many digits."""
    found, fraction = np.zeros(1), 1.0 / base
    for _ in range(digits):  # those with a digit more
        found = np.concatenate([found + fraction * digit for digit in range(base)])
        fraction /= base
    return found


def _turned(patches: Tensor, turn: Tensor) -> Tensor:
    """Each patch [n, E, E, 3] turned by ``turn % 4`` quarters and, from 4 on, mirrored."""
    result = patches.clone()
    for k in range(8):
        chosen = turn == k
        part = torch.rot90(patches[chosen], k % 4, (1, 2))
        result[chosen] = part.flip(2) if k >= 4 else part
    return result
