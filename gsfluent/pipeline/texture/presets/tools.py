"""What the procedural presets are written with: colours, mixing, layers by depth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Preset = Callable[[np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]]
"""``f(points [n, 3], depth [n], seed) -> (rgb [n, 3], key [n])``; key 0 is the matrix, any other
number is that of one inclusion (equal for all its points, whatever else is asked)."""


def paint(*values: float) -> np.ndarray:
    """A colour [3]."""
    return np.array(values, np.float32)


def mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Colours between a and b [n, 3] (or one colour [3]) by shares t [n], clipped to 0..1."""
    return (a + (b - a) * np.clip(t, 0.0, 1.0)[:, None]).astype(np.float32)


def layers(depth: np.ndarray, stops: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Piecewise linear colour [n, 3] over depth [n]."""
    position = [s[0] for s in stops]
    table = np.stack([s[1] for s in stops])
    return np.stack([np.interp(depth, position, table[:, c]) for c in range(3)], 1).astype(
        np.float32
    )
