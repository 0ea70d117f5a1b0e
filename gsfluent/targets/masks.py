"""Silhouettes of films: what of each picture is the object."""

from __future__ import annotations

from collections.abc import Sequence as Listing
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw_at
from gsfluent.errors import InputError
from gsfluent.targets.target import Followers, Motion, Setting, frame_times, joined, positive

LEVELS = (16, 32)
"""Pixels along the longer side of the pictures that are compared: coarse ones see further."""
FINE = 8
"""Pixels drawn along each of the finest: the rasterizer's low-pass makes silhouettes thicker by
half a pixel, and at 2 those of a ball were 30 % too large."""
STRETCH = (0.3, 3.0)


class Masks:
    """Masks of films from posed cameras that stand still.

    The splats of the scene are moved by its points and drawn; their alpha is compared with the
    masks on a pyramid of means.

    Args:
        cameras: C of them, in the scene's metres.
        masks: [C, T, H, W] in 0..1: 1 is the object; NaN where nothing is known.
        sigma: Standard deviation of a pixel of the pyramid.
        fps: Frames per second.
        times: Of the frames [s], instead of ``fps``.

    Raises:
        InputError: Wrong shapes, or fewer than two frames.
    """

    step = 1e-3

    def __init__(
        self,
        cameras: Listing[Camera],
        masks: Any,
        *,
        sigma: float = 0.02,
        fps: float = 24.0,
        times: Listing[float] | None = None,
    ) -> None:
        where = "targets.Masks"
        seen = torch.as_tensor(np.asarray(masks, np.float32))
        if seen.ndim != 4 or seen.shape[0] != len(cameras) or seen.shape[1] < 2:
            raise InputError(
                f"{where}: must have shape [C, T, H, W] with {len(cameras)} cameras, got "
                f"{list(seen.shape)}",
                "one film for each camera",
            )
        for camera, film in zip(cameras, seen, strict=True):
            if abs(camera.width / camera.height - film.shape[2] / film.shape[1]) > 0.02:
                raise InputError(
                    f"{where}: camera {camera.name!r} is {camera.width}x{camera.height}, its masks "
                    f"{film.shape[2]}x{film.shape[1]}",
                    "give masks of the same shape",
                )
        self.cameras, self.sigma = list(cameras), positive(where, "sigma", sigma)
        self.times = frame_times(where, seen.shape[1], fps, times)
        self.small = [_shrunk(film[:, None], LEVELS[-1])[:, 0] for film in seen]

    def observe(self, setting: Setting) -> _Silhouettes:
        """See :class:`gsfluent.targets.target.Target`."""
        return _Silhouettes(self, setting)


def _shrunk(pictures: Tensor, side: int) -> Tensor:
    """Means over pixels of pictures [N, 1, H, W], so that the longer side has so many."""
    height, width = pictures.shape[2:]
    scale = side / max(height, width)
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    return functional.adaptive_avg_pool2d(pictures, size)


class _Silhouettes:
    def __init__(self, target: Masks, setting: Setting) -> None:
        if setting.splats is None or setting.splats.count == 0:
            raise InputError("targets.Masks: the scene has no splats", "give it a solid with some")
        self.target = target
        self.splats: Gaussians = setting.splats
        self.followers = Followers("targets.Masks", self.splats.means.double(), setting)

    def pair(self, motion: Motion) -> None:
        """Nothing: pixels have places."""

    def residuals(self, motion: Motion, frames: int, pairs: Any) -> tuple[Tensor, Tensor]:
        """See :class:`gsfluent.targets.target.Observer`."""
        parts, numbers = [], list(range(1, frames))
        for k in numbers:
            means, maps = self.followers.places(motion, k)
            turn, clamped = ops.polar_clamped(maps.float(), *STRETCH)
            quats, scales = ops.carry_axes(
                self.splats.quats, self.splats.scales, clamped, turn, rigid=1e-6
            )
            moved = self.splats.replace(means=means.float(), quats=quats, scales=scales)
            rows = [self._gaps(moved, c, k) for c in range(len(self.target.cameras))]
            parts.append(torch.cat(rows).double())
        return joined(parts, numbers) if parts else (torch.zeros(0), torch.zeros(0).long())

    def _gaps(self, splats: Gaussians, number: int, frame: int) -> Tensor:
        """Differences of one picture, on every level, in standard deviations."""
        camera, seen = self.target.cameras[number], self.target.small[number][frame]
        height, width = (FINE * s for s in seen.shape)
        K = camera.K.clone()
        K[0] *= width / camera.width
        K[1] *= height / camera.height
        white = torch.ones(splats.count, 1)
        drawn = draw_at(splats, camera.viewmat, K, (width, height), colors=white,
                        antialiased=True).alpha  # fmt: skip
        alpha = functional.avg_pool2d(drawn.reshape(1, 1, height, width), FINE)[0, 0]
        known = torch.isfinite(seen)
        gap = torch.where(known, alpha - seen.nan_to_num(), 0.0)[None, None]
        levels = [gap if side == LEVELS[-1] else _shrunk(gap, side) for side in LEVELS]
        return torch.cat([level.reshape(-1) for level in levels]) / self.target.sigma
