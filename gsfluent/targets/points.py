"""Points that were tracked, and clouds whose points have no names."""

from __future__ import annotations

from collections.abc import Sequence as Listing
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.spatial.neighbours import nearest_rows
from gsfluent.targets.target import (
    Followers,
    Motion,
    Setting,
    cloud,
    frame_times,
    joined,
    positive,
)


class Points:
    """Tracked points: the strongest target.

    Args:
        positions: [T, K, 3] in the scene's metres, NaN where a point is not seen; frame 0 is the
            beginning of the scene. Points that are not seen there are left out.
        sigma: Standard deviation of a coordinate [m]; that of the first frame, by which a point is
            found in the matter, counts as well.
        fps: Frames per second.
        times: Of the frames [s], instead of ``fps``.

    Raises:
        InputError: Wrong shapes, fewer than two frames, or no point in the first.
    """

    step = 1e-4

    def __init__(
        self,
        positions: Any,
        *,
        sigma: float = 1e-3,
        fps: float = 24.0,
        times: Listing[float] | None = None,
    ) -> None:
        where = "targets.Points"
        seen = np.asarray(positions, np.float64)
        if seen.ndim != 3 or seen.shape[2] != 3 or len(seen) < 2:
            raise InputError(f"{where}: must have shape [T, K, 3], got {list(seen.shape)}", "T > 1")
        seen = seen[:, np.isfinite(seen[0]).all(axis=1)]
        if seen.shape[1] == 0:
            raise InputError(f"{where}: no point is seen in frame 0", "begin where one is")
        self.positions = torch.from_numpy(seen)
        self.sigma = positive(where, "sigma", sigma)
        self.times = frame_times(where, len(seen), fps, times)

    def observe(self, setting: Setting) -> _Tracked:
        """See :class:`gsfluent.targets.target.Target`."""
        return _Tracked(self, setting)


class _Tracked:
    def __init__(self, target: Points, setting: Setting) -> None:
        self.target = target
        self.followers = Followers("targets.Points", target.positions[0], setting)
        self.rows = self.followers.near

    def pair(self, motion: Motion) -> None:
        """Nothing: points have names."""

    def residuals(self, motion: Motion, frames: int, pairs: Any) -> tuple[Tensor, Tensor]:
        """See :class:`gsfluent.targets.target.Observer`."""
        parts, numbers = [], list(range(1, frames))
        for k in numbers:
            gap = self.followers.places(motion, k)[0] - self.target.positions[k]
            gap = gap[self.rows] / (2.0**0.5 * self.target.sigma)
            parts.append(gap[torch.isfinite(gap)])
        return joined(parts, numbers) if parts else (torch.zeros(0), torch.zeros(0).long())

    def patterns(self, motion: Motion, frame: int) -> Tensor:
        """Shifts, turns and even strains of what is seen in a frame, one a column, [R, 12]."""
        seen = torch.isfinite(self.target.positions[frame])[self.rows]
        arm = self.followers.places(motion, frame)[0][self.rows]
        arm = arm - arm.mean(dim=0)
        made = [eye.expand_as(arm) for eye in torch.eye(3, dtype=arm.dtype)]
        for sign in (-1.0, 1.0):
            for i, j in ((0, 1), (0, 2), (1, 2)):
                map = torch.zeros(3, 3, dtype=arm.dtype)
                map[i, j], map[j, i] = 1.0, sign
                made.append(arm @ map.T)
        made += [arm @ torch.diag(eye) for eye in torch.eye(3, dtype=arm.dtype)]
        return torch.stack([column[seen] for column in made], dim=1)


class Clouds:
    """Clouds of surface points, or splat centres, without names (GIC: Cai et al. 2024).

    Residuals are the vectors to the nearest point, both ways; who is nearest is seen anew at every
    linearisation. What lies within a cell of the floor is left out: matter and floor hide it.

    Args:
        clouds: One [N, 3] per frame, in the scene's metres; the first is the beginning of the scene
            and is what moves along.
        sigma: Standard deviation of a coordinate [m].
        fps: Frames per second.
        times: Of the frames [s], instead of ``fps``.
        most: Points taken of each cloud, evenly.

    Raises:
        InputError: Fewer than two clouds, or one that is none.
    """

    step = 1e-4

    def __init__(
        self,
        clouds: Listing[Any],
        *,
        sigma: float = 3e-3,
        fps: float = 24.0,
        times: Listing[float] | None = None,
        most: int = 1500,
    ) -> None:
        where = "targets.Clouds"
        if len(clouds) < 2:
            raise InputError(f"{where}: {len(clouds)} clouds", "give at least two")
        read = [cloud(f"{where}: frame {k}", one) for k, one in enumerate(clouds)]
        thin = [one[np.linspace(0, len(one) - 1, min(most, len(one))).astype(int)] for one in read]
        self.clouds = [torch.from_numpy(one[np.isfinite(one).all(axis=1)]) for one in thin]
        if not all(len(one) for one in self.clouds):
            raise InputError(f"{where}: a frame has no finite points", "leave it out")
        self.sigma = positive(where, "sigma", sigma)
        self.times = frame_times(where, len(read), fps, times)

    def observe(self, setting: Setting) -> _Cloudy:
        """See :class:`gsfluent.targets.target.Target`."""
        return _Cloudy(self, setting)


class _Cloudy:
    def __init__(self, target: Clouds, setting: Setting) -> None:
        self.target, self.setting = target, setting
        first = target.clouds[0]
        self.followers = Followers("targets.Clouds", first, setting)
        self.rows = self.followers.near.nonzero()[:, 0]
        self.cell = 0.5 * setting.dx

    def pair(self, motion: Motion) -> list[tuple[Tensor, Tensor]]:
        """Nearest seen point of each follower, nearest follower of each seen point, by frame."""
        found = []
        for k, seen in enumerate(self.target.clouds[: len(motion.position)]):
            skin = self.followers.places(motion, k)[0][self.rows]
            found.append(
                (
                    nearest_rows(seen, skin, 1, self.cell)[1][:, 0],
                    nearest_rows(skin, seen, 1, self.cell)[1][:, 0],
                )
            )
        return found

    def residuals(self, motion: Motion, frames: int, pairs: Any) -> tuple[Tensor, Tensor]:
        """See :class:`gsfluent.targets.target.Observer`."""
        floor, parts, numbers = self.setting.floor, [], list(range(1, frames))
        low = -torch.inf if floor is None else floor + self.setting.dx
        for k in numbers:
            seen = self.target.clouds[k]
            skin = self.followers.places(motion, k)[0][self.rows]
            there, back = pairs[k]
            one, other = skin - seen[there], skin[back] - seen
            one = one * (seen[there][:, 2:] > low)
            other = other * (seen[:, 2:] > low)
            # as much weight for either way, whatever the numbers of points
            share = (len(one) / max(len(other), 1)) ** 0.5
            parts.append(torch.cat([one, share * other]) / self.target.sigma)
        return joined(parts, numbers) if parts else (torch.zeros(0), torch.zeros(0).long())
