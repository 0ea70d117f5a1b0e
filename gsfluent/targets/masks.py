"""Silhouettes of films, what of each picture is the object, and at the end its colours."""

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
EDGES = (0.05, 0.95)
"""Range of the alpha at which an outline may lie."""


class Masks:
    """Masks of films from posed cameras that stand still.

    The splats of the scene are moved by its points and drawn; their alpha is compared with the
    masks on a pyramid of means. Colours show what a silhouette does not, as the spin of a ball; but
    they agree with the wrong stripe, too. So they count once all frames do, when silhouettes have
    found the way.

    Args:
        cameras: C of them, in the scene's metres.
        masks: [C, T, H, W] in 0..1: 1 is the object; NaN where nothing is known.
        colors: What the cameras saw, [C, T, H, W, 3] in 0..1, or None. What is no object does not
            matter.
        sigma: Standard deviation of a pixel of the pyramid.
        sigma_color: Likewise of its colours: what light and shade change is among it.
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
        colors: Any = None,
        sigma: float = 0.02,
        sigma_color: float = 0.1,
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
        self.sigma_color = positive(where, "sigma_color", sigma_color)
        self.colors = None if colors is None else _colored(colors, seen)
        self.small = [_shrunk(film[:, None], LEVELS[-1])[:, 0] for film in seen]

    def observe(self, setting: Setting) -> _Silhouettes:
        """See :class:`gsfluent.targets.target.Target`."""
        return _Silhouettes(self, setting)


def _colored(colors: Any, masks: Tensor) -> list[Tensor]:
    """Means of what the object shows before black, [T, 3, h, w] of each camera; NaN as of masks.

    Raises:
        InputError: Not a colour for each pixel of the masks.
    """
    films = torch.as_tensor(np.asarray(colors, np.float32))
    if films.shape != (*masks.shape, 3):
        raise InputError(
            f"targets.Masks: colors must have shape {[*masks.shape, 3]}, got {list(films.shape)}",
            "the pictures that the masks belong to",
        )
    before_black = (masks[..., None] * films).movedim(-1, 2)  # [C, T, 3, H, W]
    return [_shrunk(film, LEVELS[-1]) for film in before_black]


def _shrunk(pictures: Tensor, side: int) -> Tensor:
    """Means over pixels of pictures [N, K, H, W], so that the longer side has so many."""
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
        self.edge = 0.5
        self.edge = self._found_edge()

    def _found_edge(self) -> float:
        """Alpha that makes the silhouettes of frame 0, where all lies at rest, as large as seen."""
        alphas, known, seen = [], [], 0.0
        for camera, small in zip(self.target.cameras, self.target.small, strict=True):
            drawn = self._drawn(self.splats, camera, small[0], torch.ones(self.splats.count, 1))
            finite = torch.isfinite(small[0])
            alphas.append(drawn.alpha)
            known.append(finite.repeat_interleave(FINE, 0).repeat_interleave(FINE, 1))
            seen += float(small[0][finite].sum()) * FINE**2
        low, high = EDGES
        for _ in range(20):
            middle = 0.5 * (low + high)
            pairs = zip(alphas, known, strict=True)
            area = sum(float(_sharp(a.reshape(k.shape), middle)[k].sum()) for a, k in pairs)
            low, high = (middle, high) if area > seen else (low, middle)
        return 0.5 * (low + high)

    @staticmethod
    def _drawn(splats: Gaussians, camera: Camera, seen: Tensor, paint: Tensor) -> Any:
        """A picture of splats, `FINE` pixels for each of those that are compared."""
        height, width = (FINE * s for s in seen.shape[-2:])
        K = camera.K.clone()
        K[0] *= width / camera.width
        K[1] *= height / camera.height
        return draw_at(splats, camera.viewmat, K, (width, height), colors=paint, antialiased=True)

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
            last = frames == len(self.target.times)
            rows = [self._gaps(moved, c, k, last) for c in range(len(self.target.cameras))]
            parts.append(torch.cat(rows).double())
        return joined(parts, numbers) if parts else (torch.zeros(0), torch.zeros(0).long())

    def _gaps(self, splats: Gaussians, number: int, frame: int, last: bool) -> Tensor:
        """Differences of one picture, on every level, in standard deviations."""
        target = self.target
        camera, seen = target.cameras[number], target.small[number][frame]
        height, width = (FINE * s for s in seen.shape)
        colored = last and target.colors is not None
        paint = splats.colors() if colored else torch.ones(splats.count, 1)
        drawn = self._drawn(splats, camera, seen, paint)
        outline = _sharp(drawn.alpha.reshape(1, 1, height, width), self.edge)
        alpha = functional.avg_pool2d(outline, FINE)
        rows = _levels(alpha, seen[None, None]) / target.sigma
        if not colored:
            return rows
        assert target.colors is not None
        image = drawn.image.reshape(1, height, width, 3).permute(0, 3, 1, 2)
        there = target.colors[number][frame][None]
        more = _levels(functional.avg_pool2d(image, FINE), there) / target.sigma_color
        return torch.cat([rows, more])


def _sharp(alpha: Tensor, edge: float) -> Tensor:
    """Coverage of pixels whose outline lies where alpha is ``edge``: a ramp about it."""
    return (0.5 + 0.5 * (alpha - edge) / min(edge, 1.0 - edge)).clamp(0.0, 1.0)


def _levels(drawn: Tensor, seen: Tensor) -> Tensor:
    """Differences of pictures [1, K, H, W] on every level; none where nothing was seen."""
    gap = torch.where(torch.isfinite(seen), drawn - seen.nan_to_num(), 0.0)
    levels = [gap if side == LEVELS[-1] else _shrunk(gap, side) for side in LEVELS]
    return torch.cat([level.reshape(-1) for level in levels])
