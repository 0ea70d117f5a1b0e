"""Inpainters without a network: Telea, colour diffusion, and guided patches of a photograph."""

from __future__ import annotations

import functools

import numpy as np

from gsfluent._lazy import cv2
from gsfluent.errors import InputError, check_choice
from gsfluent.pipeline.texture.inpaint.inpainter import Job, MaskedInpainter
from gsfluent.pipeline.texture.photo.exemplar import Exemplar
from gsfluent.pipeline.texture.synthesis.patches import Schedule, project_slice
from gsfluent.pipeline.texture.volume.domain import block_mean, nearest_in

# work per slice; iterations are per pyramid level when repainting
_SCHEDULE = Schedule(iterations=(4, 3, 2), bank=1536, samples=400)
_REPAINT = 0.7  # strengths from here on start from nothing instead of from the slice


def _without_ground(picture: np.ndarray, inside: np.ndarray | None) -> np.ndarray:
    """The picture with the object's colours continued outward, so that no ground leaks in."""
    if inside is None or inside.all() or not inside.any():
        return picture
    return picture[nearest_in(inside)]


class TeleaInpainter(MaskedInpainter):
    """``cv2.inpaint``: fast marching (Telea 2004) or Navier-Stokes (Bertalmio et al. 2001).

    Args:
        method: ``telea`` or ``ns``.
    """

    name = "telea"

    def __init__(self, method: str = "telea") -> None:
        check_choice("inpaint: method", method, ("telea", "ns"), "telea is usual")
        self.name = method

    def paint(self, job: Job) -> np.ndarray:
        """Fill from the hole's edge inward."""
        kind = cv2.INPAINT_TELEA if self.name == "telea" else cv2.INPAINT_NS
        made = np.empty_like(job.slices)
        for k, (picture, hole) in enumerate(zip(job.slices, job.mask, strict=True)):
            if hole.all():  # nothing known to start from
                made[k] = picture
                continue
            inside = None if job.context.inside is None else job.context.inside[k]
            extended = _without_ground(picture, inside)
            pixels = (extended.clip(0, 1) * 255).round().astype(np.uint8)
            filled = cv2.inpaint(pixels, hole.astype(np.uint8), 3.0, kind)
            made[k] = filled.astype(np.float32) / 255.0
        return job.slices + np.float32(job.strength) * (made - job.slices)


class ColorDiffusionInpainter(MaskedInpainter):
    """Harmonic fill: the membrane through the known colours at the hole's edge (Laplace)."""

    name = "color"

    def paint(self, job: Job) -> np.ndarray:
        """Solve the discrete Laplace equation in every hole."""
        made = job.slices.copy()
        for k, hole in enumerate(job.mask):
            if not hole.all():
                made[k][hole] = _harmonic(job.slices[k], hole)
        return job.slices + np.float32(job.strength) * (made - job.slices)


def _harmonic(picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Colours [n, 3] of the hole's pixels: each the mean of its neighbours."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    count = int(hole.sum())
    number = np.full(hole.shape, -1)
    number[hole] = np.arange(count)
    degree = np.zeros(count)
    right = np.zeros((count, 3))
    rows: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
        at = number.take(range(1, hole.shape[axis]), axis)
        other = number.take(range(hole.shape[axis] - 1), axis)
        color = picture.take(range(hole.shape[axis] - 1), axis)
        if shift < 0:
            at, other = other, at
            color = picture.take(range(1, hole.shape[axis]), axis)
        here = at >= 0
        degree += np.bincount(at[here], minlength=count)
        known = here & (other < 0)
        np.add.at(right, at[known], color[known])
        both = here & (other >= 0)
        rows.append(at[both])
        columns.append(other[both])
    i, j = np.concatenate(rows), np.concatenate(columns)
    # a pixel cut off from all known ones keeps a solvable equation of its own
    diagonal = degree + 1e-9
    matrix = sparse.coo_matrix((-np.ones(len(i)), (i, j)), (count, count)).tocsc()
    solved = splu(matrix + sparse.diags(diagonal).tocsc()).solve(right)
    return np.asarray(solved, np.float32).clip(0.0, 1.0)


class ExemplarInpainter(MaskedInpainter):
    """Guided patch projection within each slice: patches of the photograph, matched by depth.

    The engine of the exemplar method (:mod:`.synthesis`) confined to one slice. Every slice is
    made by itself, which is what a 2-D model does too; so this is the offline proxy of one.

    Args:
        exemplar: Photograph when a call brings none.
    """

    name = "exemplar"

    def __init__(self, exemplar: Exemplar | None = None) -> None:
        self.exemplar = exemplar
        self._fitted: dict[tuple[int, float, int], Exemplar] = {}

    def paint(self, job: Job) -> np.ndarray:
        """Project every slice onto the photograph's patches."""
        photo = job.exemplar or self.exemplar
        if photo is None:
            raise InputError(
                "inpaint: backend 'exemplar' needs an exemplar photograph",
                hint="add exemplar: cut.jpg, or choose backend telea or color",
            )
        return np.stack([self._slice(job, k, photo) for k in range(len(job.slices))])

    def _slice(self, job: Job, k: int, photo: Exemplar) -> np.ndarray:
        """One slice, coarse to fine when it is repainted."""
        picture, hole, context, strength = job.slices[k], job.mask[k], job.context, job.strength
        inside = np.ones(hole.shape, bool) if context.inside is None else context.inside[k] | hole
        depth = None if context.guide is None or not photo.silhouette else context.guide[k]
        rng = np.random.default_rng(job.seeds[k])
        largest = context.max_depth if context.max_depth > 0 else max(hole.shape) / 2
        if depth is not None:
            factor = largest / max(photo.max_depth, 1.0)
        else:
            factor = max(hole.shape) / max(photo.mask.shape)
        repaint = strength >= _REPAINT
        factors = [f for f in (4, 2, 1) if min(hole.shape) // f >= 8] if repaint else [1]
        iterations = _SCHEDULE.iterations[-len(factors) :]
        if not repaint:
            iterations = (max(1, round(4 * strength)),)
        rgb = picture
        for step, (shrink, rounds) in enumerate(zip(factors, iterations, strict=True)):
            fitted = self._photo(photo, factor, shrink)
            image, open_, within, below = _reduced(picture, hole, inside, depth, shrink)
            if step == 0 and repaint:
                image = _start(image, open_, below, fitted, rng)
            elif step > 0:
                image = np.where(open_[..., None], _enlarged(rgb, open_.shape), image)
            rgb = image
            if open_.any():
                shown = np.zeros(fitted.mask.shape, np.float32)
                if depth is not None:
                    shown = _saturating(fitted.depth, fitted.max_depth)
                rgb = project_slice(
                    image, within, within & ~open_, 3.0 * _saturating(below, largest / shrink),
                    (fitted.image, fitted.mask, 3.0 * shown), _SCHEDULE, rounds, rng,
                )  # fmt: skip
        return rgb

    def _photo(self, photo: Exemplar, factor: float, shrink: int) -> Exemplar:
        """The photograph at the pitch of a level; kept, since every slice wants the same."""
        key = (id(photo), round(factor, 6), shrink)
        if key not in self._fitted:
            if len(self._fitted) > 16:
                self._fitted.clear()
            self._fitted[key] = photo.resized(factor / shrink)
        return self._fitted[key]


def _saturating(depth: np.ndarray, largest: float) -> np.ndarray:
    """Depth guide: steep near the skin, where layers are thin, flat in the core."""
    return (1.0 - np.exp(-1.5 * depth / max(largest, 1e-6))).astype(np.float32)


def _start(
    image: np.ndarray,
    hole: np.ndarray,
    depth: np.ndarray,
    photo: Exemplar,
    rng: np.random.Generator,
) -> np.ndarray:
    """Photograph pixels of about the same depth in every hole pixel: right colours, no order."""
    order = np.argsort(photo.depth[photo.mask], kind="stable")
    sorted_depth = photo.depth[photo.mask][order]
    colors = photo.image[photo.mask][order]
    wanted = depth[hole]
    if len(wanted) == 0:  # too small a hole for this level
        return image
    if float(np.ptp(wanted)) < 1e-6:
        place = rng.integers(0, len(colors), len(wanted))
    else:
        middle = np.searchsorted(sorted_depth, wanted)
        spread = max(1, len(colors) // 40)
        place = middle + rng.integers(-spread, spread + 1, len(wanted))
    made = image.copy()
    made[hole] = colors[place.clip(0, len(colors) - 1)]
    return made


def _reduced(
    picture: np.ndarray,
    hole: np.ndarray,
    inside: np.ndarray,
    depth: np.ndarray | None,
    factor: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Picture, hole, object and depth [coarse pixels] at 1/factor resolution."""
    below = np.zeros(hole.shape, np.float32) if depth is None else depth
    if factor == 1:
        return picture, hole, inside, below
    blocks = functools.partial(block_mean, factor=factor, dimensions=2)
    share = blocks(inside)
    within = share > 0.4
    color = blocks(picture * inside[..., None]) / np.maximum(share, 1e-3)[..., None]
    deep = blocks(below * inside) / np.maximum(share, 1e-3) / factor
    open_ = within & (blocks(hole) > 0.5)
    return color, open_, within, np.where(within, deep, 0.0).astype(np.float32)


def _enlarged(picture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    big = cv2.resize(picture, (2 * picture.shape[1], 2 * picture.shape[0]))
    grown = [max(0, s - b) for s, b in zip(shape, big.shape[:2], strict=True)]
    padded = np.pad(big, [(0, grown[0]), (0, grown[1]), (0, 0)], mode="edge")
    return padded[: shape[0], : shape[1]]
