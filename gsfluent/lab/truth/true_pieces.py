"""True pieces of a broken solid: its smooth partition where voxels are fine, and rigid motions.

What :mod:`gsfluent.pipeline.partition` is judged by. The partition is defined by its points alone:
the label of the nearest, smoothed by two blurs and the largest share, volumes kept, faces displaced
by a field of the rest place (docs/theory/partition.md). Here it is made on voxels as fine as one
likes with true Gaussians, at once for the pieces of the last frame, and nothing of the pipeline is
used. A piece moves by the best rigid fit to its points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDE = (1.2, 0.8)
"""Standard deviations of the two blurs of pieces, in point spacings."""
NARROW = (0.5, 0.4)
"""The same for chips."""
CHIP = 64
"""Points from which on a label is a piece."""
_CLEAR = 0.95  # lead from which on no displacement changes a label
_LOST = 0.7  # share of its voxels that a label keeps when it is smoothed, or it is not
_PASSES = 60
_STRAY = 1.5  # spacings from the fit beyond which a point is not of its piece any more
_ROUNDS = 4

Labels = NDArray[np.int32]
Floats = NDArray[np.float32]


def partition(
    nearest: Labels, sizes: NDArray[np.int64], spacing: float, shift: Floats | None = None
) -> Labels:
    """Smooth labels of voxels.

    Chips are told from all else first, with narrow blurs; then pieces from each other.

    Args:
        nearest: Label of the nearest point of each voxel, -1 outside of the solid, [X, Y, Z].
        sizes: Points of each label, [F].
        spacing: Distance of the points [voxels].
        shift: By how much the faces are displaced [voxels], [3, X, Y, Z]; None for not at all.

    Returns:
        Label of each voxel, [X, Y, Z].
    """
    wanted = sizes * ((nearest >= 0).sum() / sizes.sum())
    found, large = nearest, sizes >= CHIP
    if not large.all():
        # 0 for what is no chip
        chip = np.where(large, 0, 1 + np.arange(len(sizes)))
        each = np.bincount(chip, wanted, minlength=len(sizes) + 1).astype(np.float64)
        told = _told(_renamed(nearest, chip), each, NARROW, spacing, shift)
        found = np.where(told > 0, told - 1, nearest)
        # voxels of chips that pieces have won go to the piece beside
        lost = (told == 0) & ~large[nearest]
        if lost.any() and large.any():
            from scipy import ndimage

            whole = (told == 0) & ~lost
            at = ndimage.distance_transform_edt(~whole, return_distances=False, return_indices=True)
            found = np.where(lost, nearest[tuple(at)], found)
    if large.sum() > 1:
        rest = np.where((found >= 0) & large[found], found, -1).astype(np.int32)
        # what the chips have taken too much is taken from all
        share = wanted * large
        share *= (rest >= 0).sum() / share.sum()
        found = np.where(rest >= 0, _told(rest, share, WIDE, spacing, shift), found)
    return found.astype(np.int32)


def _renamed(labels: Labels, names: NDArray[np.int64]) -> Labels:
    return np.where(labels >= 0, names[labels], -1).astype(np.int32)


def _told(
    labels: Labels, wanted: NDArray[np.float64], sigmas: tuple[float, float], spacing: float,
    shift: Floats | None,
) -> Labels:  # fmt: skip
    """Labels after two blurs, displaced, with volumes [voxels] as wanted."""
    from scipy import ndimage

    inside, best = labels >= 0, np.zeros(labels.shape, np.float32)
    won = labels.copy()
    for label, span, share in _shares(labels, sigmas[0] * spacing):
        more = inside[span] & (share > best[span])
        best[span][more], won[span][more] = share[more], label
    # what is as thin as a point is blurred away: it keeps what it had
    had, has = (np.bincount(x[inside], minlength=len(wanted)) for x in (labels, won))
    won = np.where(inside & (has < _LOST * had)[labels], labels, won)
    fields = list(_shares(won, sigmas[1] * spacing))
    tops = _Top(labels.shape)
    for label, span, share in fields:
        tops.enter(label, span, share)
    near = np.nonzero(inside & (tops.one - tops.two < _CLEAR))
    place = np.stack(near).astype(np.float32)
    if shift is not None:
        place += shift[:, near[0], near[1], near[2]]
    top = _Top((place.shape[1],))
    for label, span, share in fields:
        low = np.array([[s.start] for s in span])
        high = np.array([[s.stop - 1] for s in span])
        rows = np.nonzero(((place >= low) & (place <= high)).all(axis=0))[0]
        value = ndimage.map_coordinates(share, place[:, rows] - low, order=1, mode="nearest")
        top.enter(label, rows, value)
    calm = inside.copy()
    calm[near] = False
    fixed = np.bincount(tops.first[calm], minlength=len(wanted)).astype(float)
    first, second = (np.where(x < 0, tops.first[near], x) for x in (top.first, top.second))
    out = np.where(inside, tops.first, -1)
    out[near] = _kept(first, second, top.one - top.two, fixed, wanted)
    return out.astype(np.int32)


class _Top:
    """The two largest of some fields."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.first, self.second = np.full(shape, -1, np.int32), np.full(shape, -1, np.int32)
        self.one, self.two = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def enter(self, label: int, at: Any, share: Floats) -> None:
        """Take in a field where it is."""
        one, two = self.one[at], self.two[at]
        ahead, next_ = share > one, (share > two) & (share <= one)
        first, second = self.first[at], self.second[at]
        self.second[at] = np.where(ahead, first, np.where(next_, label, second))
        self.two[at] = np.where(ahead, one, np.where(next_, share, two))
        self.first[at] = np.where(ahead, label, first)
        self.one[at] = np.where(ahead, share, one)


def _shares(labels: Labels, sigma: float) -> Iterator[tuple[int, tuple[slice, ...], Floats]]:
    """Share of every label around each voxel of a box around it."""
    from scipy import ndimage

    whole = ndimage.gaussian_filter((labels >= 0).astype(np.float32), sigma, mode="constant")
    margin = int(4.0 * sigma) + 2
    for number, box in enumerate(ndimage.find_objects(labels + 1)):
        if box is None:
            continue
        span = tuple(
            slice(max(0, s.start - margin), min(n, s.stop + margin))
            for s, n in zip(box, labels.shape, strict=True)
        )
        mask = (labels[span] == number).astype(np.float32)
        share = ndimage.gaussian_filter(mask, sigma, mode="constant")
        yield number, span, share / np.maximum(whole[span], 1e-6)


def _kept(
    first: Labels, second: Labels, lead: Floats, fixed: NDArray[np.float64],
    wanted: NDArray[np.float64],
) -> Labels:  # fmt: skip
    """Labels near faces once constants are added to the shares, by which volumes are kept."""
    offset, best = np.zeros(len(wanted)), (np.inf, first)
    one, two = first, np.maximum(second, 0)
    for turn in range(_PASSES):
        now = np.where(second >= 0, lead + offset[one] - offset[two], 1.0)
        mine = np.where(now >= 0.0, one, two)
        error = fixed + np.bincount(mine, minlength=len(wanted)) - wanted
        worst = float((np.abs(error) / np.maximum(wanted, 1.0)).max())
        if worst < best[0]:
            best = worst, mine
        band = np.abs(now) < 0.1
        slope = np.bincount(one[band], minlength=len(wanted)) + np.bincount(
            two[band], minlength=len(wanted)
        )
        step = error / np.maximum(slope / 0.2, 1.0)
        offset = offset - (0.6 / (1.0 + 0.1 * turn)) * step.clip(-0.1, 0.1)
    return best[1]


def rigid_fit(
    rest: NDArray[np.float64], now: NDArray[np.float64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation [3, 3] and translation [3] that take points to where they are.

    Least squares (Kabsch 1976), a few rounds without what has strayed from the last one.

    Args:
        rest: Points at rest [m], [P, 3].
        now: The same points now [m], [P, 3].
        spacing: Distance between points [m].
    """
    kept = np.ones(len(rest), bool)
    for _ in range(_ROUNDS):
        a, b = rest[kept], now[kept]
        middle = a.mean(axis=0), b.mean(axis=0)
        u, _, vh = np.linalg.svd((b - middle[1]).T @ (a - middle[0]))
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vh))]) @ vh
        move = middle[1] - turn @ middle[0]
        off = np.linalg.norm(rest @ turn.T + move - now, axis=1)
        # never less than half of the points
        kept = off <= max(_STRAY * spacing, float(np.median(off)))
    return turn, move


def bent_fit(
    rest: NDArray[np.float64], now: NDArray[np.float64], spacing: float
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """As :func:`rigid_fit`, a polynomial of degree two in the place at rest."""
    middle, size = rest.mean(axis=0), float(np.ptp(rest, axis=0).max())

    def terms(places: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = ((places - middle) / size).T
        one = np.ones_like(x)
        return np.stack([one, x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], axis=1)

    known, kept = terms(rest), np.ones(len(rest), bool)
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(known[kept], now[kept], rcond=None)[0]
        off = np.linalg.norm(known @ found - now, axis=1)
        kept = off <= max(_STRAY * spacing, float(np.median(off)))
    return lambda places: terms(places) @ found


Displacement = Callable[[NDArray[np.float64]], Floats]
"""Displacement [m] of places [m], [M, 3] each."""
