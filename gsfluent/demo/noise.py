"""Smooth value noise on a periodic lattice, evaluated at arbitrary points.

The demo objects are coloured by solid noise: a colour belongs to a point in space, so a photograph
of the surface and any cut through the same object agree. One seed gives the same values everywhere.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_LATTICE = 32


class SolidNoise:
    """Value noise in three dimensions with a C1 interpolant.

    Args:
        seed: Seed of the random lattice.
        channels: Independent noise values per point.
    """

    def __init__(self, seed: int, channels: int = 1) -> None:
        values = np.random.default_rng(seed).standard_normal((channels,) + (_LATTICE,) * 3)
        clipped = np.clip(values, -2.0, 2.0).astype(np.float32) * 0.5
        wrapped = np.pad(clipped, ((0, 0), (0, 1), (0, 1), (0, 1)), mode="wrap")
        self._volume = torch.from_numpy(np.ascontiguousarray(wrapped))[None]

    def __call__(self, points: Tensor, frequency: float) -> Tensor:
        """Noise at ``points * frequency``.

        Args:
            points: Positions, shape [N, 3].
            frequency: Lattice cells per unit length.

        Returns:
            Values of roughly [-1, 1], shape [N, channels].
        """
        cell = torch.remainder(points.to(torch.float32) * frequency, float(_LATTICE))
        base = torch.floor(cell)
        fraction = cell - base
        smooth = base + fraction * fraction * (3.0 - 2.0 * fraction)
        grid = (smooth * (2.0 / _LATTICE) - 1.0).flip(-1).view(1, -1, 1, 1, 3)
        sampled = torch.nn.functional.grid_sample(
            self._volume, grid, mode="bilinear", padding_mode="border", align_corners=True
        )
        return sampled[0, :, :, 0, 0].T

    def fractal(self, points: Tensor, frequency: float, octaves: int) -> Tensor:
        """Sum of ``octaves`` noises, each of twice the frequency and half the strength."""
        total = self(points, frequency)
        for octave in range(1, octaves):
            offset = 11.3 * octave
            total = total + self(points + offset, frequency * 2.0**octave) * 0.5**octave
        return total


def smoothstep(low: float, high: float, value: Tensor) -> Tensor:
    """Cubic ramp from 0 at ``low`` to 1 at ``high`` (``low > high`` ramps down)."""
    t = ((value - low) / (high - low)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mix(first: Tensor, second: Tensor, weight: Tensor) -> Tensor:
    """Linear blend of colours [N, 3] (or [3]) by ``weight`` [N]."""
    w = weight[:, None]
    return first * (1.0 - w) + second * w


def rgb(*value: float) -> Tensor:
    """A colour, float32 [3]."""
    return torch.tensor(value, dtype=torch.float32)
