"""What moves: the same points at a number of times, with the triangles between them if it has any.

Rows keep their meaning from frame to frame. A point that is NaN in a frame is not there.
"""

from __future__ import annotations

from collections.abc import Sequence as Listing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.limits import within

FPS = 24.0
"""Frames per second where neither the file nor the caller says so."""


@dataclass(frozen=True, eq=False)
class Sequence:
    """Points that move.

    Attributes:
        positions: [T, N, 3], in the units and axes of the file; NaN for points that are not there.
        times: Seconds, ascending, [T].
        faces: Triangles, int64 [F, 3]; None for points alone.
    """

    positions: NDArray[np.float64]
    times: NDArray[np.float64]
    faces: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.times)

    def placed(self, turn: NDArray[np.float64], scale: float) -> Sequence:
        """The same motion, turned by a matrix [3, 3] and scaled."""
        return replace(self, positions=scale * (self.positions @ turn.T))


def checked(
    where: object, positions: Any, times: Any = None, faces: Any = None, fps: float | None = None
) -> Sequence:
    """Make a sequence of arrays, or say what is wrong with them.

    Args:
        where: What to call them in an error.
        positions: [T, N, 3].
        times: [T] in seconds; evenly spaced by ``fps`` when None.
        faces: [F, 3] or None.
        fps: Frames per second where there are no times; 24 when None.

    Raises:
        InputError: Wrong shapes, nothing in it, a face that names no point, times that do not
            ascend, infinite values, or no point at all in a frame.
    """
    try:
        points = np.asarray(positions, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: no numbers ({error})", "give [T, N, 3]") from error
    if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape:
        raise InputError(
            f"{where}: positions must have shape [T, N, 3], got {list(points.shape)}",
            "frames first, then points, then x, y, z",
        )
    if np.isinf(points).any() or np.isnan(points).all(axis=(1, 2)).any():
        raise InputError(f"{where}: a frame has no finite points", "export it again")
    count = points.shape[0]
    if times is None:
        times = np.arange(count) / (FPS if fps is None else fps)
    clock = np.asarray(times, np.float64).reshape(-1)
    if clock.shape[0] != count or not np.isfinite(clock).all() or (np.diff(clock) <= 0).any():
        raise InputError(
            f"{where}: times must be {count} ascending numbers [s]", "one for each frame"
        )
    triangles = None
    if faces is not None:
        triangles = np.asarray(faces)
        good = triangles.ndim == 2 and triangles.shape[1] == 3 and triangles.dtype.kind in "iu"
        if not good or (
            triangles.size and not 0 <= triangles.min() <= triangles.max() < points.shape[1]
        ):
            raise InputError(
                f"{where}: faces must be whole numbers [F, 3] below {points.shape[1]}",
                "export triangles",
            )
        triangles = triangles.astype(np.int64) if triangles.size else None
    return Sequence(points, clock, triangles)


def stacked(where: object, frames: Listing[NDArray[Any]]) -> NDArray[np.float64]:
    """Frames of [N, 3] as one array.

    Raises:
        InputError: Their numbers of points differ, or they are too many together.
    """
    counts = sorted({len(frame) for frame in frames})
    if len(counts) != 1:
        raise InputError(
            f"{where}: frames have from {counts[0]} to {counts[-1]} points",
            "export points that keep their order and number; NaN for those that are not there",
        )
    within("unpacked_bytes", 24 * counts[0] * len(frames), where)
    return np.stack([np.asarray(frame, np.float64) for frame in frames])
