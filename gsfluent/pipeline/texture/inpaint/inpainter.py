"""What every slice inpainter takes and gives, and what all of them share.

An inpainter sees pictures of slices with holes. Where the pictures come from, how often they are
asked for, and how the answers become one volume is the business of :mod:`.inpaint`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from gsfluent.errors import RunError
from gsfluent.pipeline.texture.photo.exemplar import Exemplar


@dataclass(frozen=True)
class SliceContext:
    """Where slices lie in the object; every field may be used by a backend or ignored.

    Attributes:
        axis: Object axis that the slices lie across (0, 1, 2).
        offsets: Index of each slice along the axis [voxels], length B.
        pitch: Edge of a pixel, world units.
        inside: Object pixels, bool [B, H, W]; outside lies neutral ground.
        guide: Depth below the object's surface [pixels], float32 [B, H, W].
        max_depth: Largest depth in the whole object [pixels].
        labels: Inclusion or part numbers, int32 [B, H, W]; None when there are none.
    """

    axis: int = 0
    offsets: tuple[int, ...] = ()
    pitch: float = 1.0
    inside: np.ndarray | None = None
    guide: np.ndarray | None = None
    max_depth: float = 0.0
    labels: np.ndarray | None = None

    def take(self, index: Sequence[int] | np.ndarray) -> SliceContext:
        """The context of some of the slices."""
        chosen = np.asarray(index, dtype=int)

        def part(field: np.ndarray | None) -> np.ndarray | None:
            return None if field is None else field[chosen]

        offsets = tuple(self.offsets[i] for i in chosen.tolist()) if self.offsets else ()
        return replace(
            self,
            offsets=offsets,
            inside=part(self.inside),
            guide=part(self.guide),
            labels=part(self.labels),
        )


@dataclass(frozen=True)
class Job:
    """Slices with holes, and what is known about them.

    Attributes:
        slices: float32 [B, H, W, 3] in 0..1.
        mask: Holes, bool [B, H, W].
        prompt: What a slice shows.
        exemplar: Photograph of such a cut.
        strength: 1 repaints from nothing, towards 0 stays closer to ``slices``.
        seeds: One per slice.
        context: Where the slices lie.
    """

    slices: np.ndarray
    mask: np.ndarray
    prompt: str
    exemplar: Exemplar | None
    strength: float
    seeds: list[int]
    context: SliceContext

    def take(self, index: Sequence[int] | np.ndarray) -> Job:
        """The job for some of the slices."""
        chosen = np.asarray(index, dtype=int)
        return replace(
            self,
            slices=self.slices[chosen],
            mask=self.mask[chosen],
            seeds=[self.seeds[i] for i in chosen.tolist()],
            context=self.context.take(chosen),
        )


@runtime_checkable
class Inpainter(Protocol):
    """A 2-D backend.

    Attributes:
        name: For reports.
        sequential: True when the slices of a call are an ordered stack that the backend treats
            together (video and multi-view models); False when every slice stands for itself.
    """

    name: str
    sequential: bool

    def __call__(
        self,
        slices: np.ndarray,
        mask: np.ndarray,
        *,
        prompt: str = "",
        exemplar: Exemplar | None = None,
        strength: float = 1.0,
        seeds: Sequence[int] | None = None,
        context: SliceContext | None = None,
    ) -> np.ndarray:
        """Fill the holes.

        Args:
            slices: float32 [B, H, W, 3] in 0..1.
            mask: bool [B, H, W]; True is repainted, everything else comes back bit for bit.
            prompt: What a slice shows.
            exemplar: Photograph of such a cut.
            strength: 1 repaints from nothing, towards 0 stays closer to ``slices``.
            seeds: One per slice; zeros by default. The same seeds give the same result.
            context: Where the slices lie.

        Returns:
            float32 [B, H, W, 3] in 0..1. Without a hole it is ``slices``, and no model was called.

        Raises:
            ValueError: Shapes do not fit.
            RunError: The backend failed.
        """
        ...


class MaskedInpainter:
    """Base of the backends here: checks, slices without a hole, known pixels.

    A backend implements :meth:`paint`; it sees only slices that have a hole.
    """

    name: str = "inpainter"
    sequential: bool = False

    def __call__(
        self,
        slices: np.ndarray,
        mask: np.ndarray,
        *,
        prompt: str = "",
        exemplar: Exemplar | None = None,
        strength: float = 1.0,
        seeds: Sequence[int] | None = None,
        context: SliceContext | None = None,
    ) -> np.ndarray:
        """Fill the holes: see :class:`Inpainter`."""
        if slices.ndim != 4 or slices.shape[-1] != 3 or mask.shape != slices.shape[:3]:
            raise ValueError(
                f"slices must be [B, H, W, 3] and mask [B, H, W], got {list(slices.shape)} "
                f"and {list(mask.shape)}"
            )
        if seeds is not None and len(seeds) != len(slices):
            raise ValueError(f"{len(seeds)} seeds for {len(slices)} slices")
        if not 0.0 < strength <= 1.0:
            raise ValueError(f"strength must be in 0..1, got {strength}")
        mask = mask.astype(bool)
        wanted = np.flatnonzero(mask.any((1, 2)))
        result = slices.astype(np.float32, copy=True)
        if len(wanted) == 0:
            return result
        own = [0] * len(slices) if seeds is None else [int(s) for s in seeds]
        whole = Job(result, mask, prompt, exemplar, strength, own, context or SliceContext())
        job = whole.take(wanted)
        made = self.paint(job)
        if made.shape != job.slices.shape:
            raise RunError(
                f"{self.name}: made pictures of shape {list(made.shape)} for slices "
                f"{list(job.slices.shape)}"
            )
        if not np.isfinite(made[job.mask]).all():
            raise RunError(f"{self.name}: made NaN or infinite colours")
        # models change known pixels too (a VAE round trip does): only holes are taken from them
        result[wanted] = np.where(job.mask[..., None], made.clip(0.0, 1.0), job.slices)
        return result

    def paint(self, job: Job) -> np.ndarray:
        """Pictures [B, H, W, 3] whose holes are filled; other pixels do not matter."""
        raise NotImplementedError(f"{type(self).__name__} has no paint()")


def slice_seed(seed: int, number: int, axis: int, index: int) -> int:
    """Seed of one slice: names the slice, not its place in a batch or in a resumed run."""
    text = f"{seed}/{number}/{axis}/{index}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6])


def combined_seed(seeds: Sequence[int]) -> int:
    """One seed for several slices on one canvas."""
    if len(seeds) == 1:
        return int(seeds[0])
    text = "/".join(str(int(s)) for s in seeds)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6])
