"""Presets of matter that is about the same throughout: fracture faces with a grain, no layers.

Those of :data:`TINTED` are brightness about one, times :data:`GREY`: inside an object they take the
colour of its skin, which is the colour of such matter.
"""

from __future__ import annotations

import numpy as np

from gsfluent.pipeline.texture.presets.tools import layers, mix, paint
from gsfluent.pipeline.texture.volume.domain import smoothstep
from gsfluent.pipeline.texture.volume.noise import cells, fractal

GREY = 0.6


def plain(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """One colour, a little uneven: what is left when nothing is known."""
    tone = 1 + 0.09 * fractal(points, 2.2, seed, 3) + 0.04 * fractal(points, 13.0, seed + 1, 2)
    return _grey(tone)


def grain(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Grains of several tones pressed together: sandstone, soil, sugar, snow."""
    tone = 1 + 0.05 * fractal(points, 2.0, seed, 3)
    for frequency, spread in ((11.0, 0.16), (26.0, 0.14)):
        found = cells(points, frequency, seed + int(frequency))
        tone = tone + spread * (found.random(1) - 0.5)
    return _grey(tone)


def stone(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Crystals of three minerals, interlocked, with faint beds: a fresh face of rock."""
    bent = points + 0.05 * np.stack([fractal(points, 5.0, seed + i, 2) for i in range(3)], 1)
    found = cells(bent, 9.0, seed + 3)
    kind = found.random(1)
    tone = np.where(kind < 0.12, 0.55, np.where(kind < 0.55, 0.92, 1.12))
    small = cells(bent, 21.0, seed + 4)
    tone = np.where(small.random(1) < 0.10, 0.62, tone + 0.10 * (small.random(2) - 0.5))
    tone = tone + 0.06 * fractal(points * [0.6, 0.6, 2.4], 1.8, seed + 5, 3)
    # fresh matter is lighter than a weathered skin
    return _grey(1.06 * tone)


def foam(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Bubbles of two sizes in thin walls."""
    tone = 1 + 0.03 * fractal(points, 3.0, seed, 2)
    for frequency, share in ((9.0, 0.9), (19.0, 0.7)):
        found = cells(points, frequency, seed + int(frequency), jitter=0.9)
        size = 0.30 + 0.20 * found.random(3)
        hole = smoothstep((size - found.first) / 0.12) * (found.random(4) < share)
        tone = tone * (1 - 0.22 * hole)
    return _grey(tone)


def clear(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Glass and ice: the skin's colour, a little deeper inside, with faint streaks."""
    tone = 1.06 - 0.16 * depth + 0.04 * fractal(points * [1.0, 1.0, 0.3], 3.0, seed, 3)
    return _grey(tone)


def chocolate(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A dull, finely crumbled break with small bubbles, a little lighter than the glossy skin."""
    tone = 1.12 + 0.06 * fractal(points, 4.0, seed, 3) + 0.05 * fractal(points, 17.0, seed + 1, 2)
    found = cells(points, 12.0, seed + 2, jitter=0.9)
    hole = smoothstep((0.20 - found.first) / 0.10) * (found.random(1) < 0.25)
    return _grey(tone * (1 - 0.30 * hole))


def plaster(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """White gypsum: matt, chalky, a few air holes; whatever its skin was painted with."""
    tone = 1 + 0.03 * fractal(points, 3.0, seed, 3) + 0.03 * fractal(points, 20.0, seed + 1, 2)
    found = cells(points, 8.0, seed + 2, jitter=0.9)
    hole = smoothstep((0.14 - found.first) / 0.06) * (found.random(1) < 0.3)
    rgb = paint(0.90, 0.885, 0.85) * (tone * (1 - 0.25 * hole))[:, None]
    return rgb.astype(np.float32), np.zeros(len(points), np.int64)


def ceramic(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The fired body below a glaze: off-white, fine, matt."""
    tone = 1 + 0.04 * fractal(points, 4.0, seed, 3) + 0.03 * fractal(points, 24.0, seed + 1, 2)
    rgb = paint(0.89, 0.87, 0.82) * tone[:, None]
    return rgb.astype(np.float32), np.zeros(len(points), np.int64)


def egg(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A boiled egg: shell, white, and a yolk in the middle."""
    edge = depth + 0.02 * fractal(points, 2.5, seed, 2)
    rgb = layers(
        edge,
        [
            (0.0, paint(0.86, 0.74, 0.62)),
            (0.05, paint(0.96, 0.94, 0.90)),
            (0.38, paint(0.95, 0.93, 0.87)),
            (0.42, paint(0.95, 0.72, 0.22)),
            (1.0, paint(0.93, 0.62, 0.12)),
        ],
    )
    crumb = fractal(points, 16.0, seed + 1, 2) * smoothstep((edge - 0.40) / 0.04)
    return (rgb * (1 + 0.06 * crumb)[:, None]).astype(np.float32), np.zeros(len(points), np.int64)


def pumpkin(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Firm orange flesh below a thin rind, stringy and deeper in colour toward the middle."""
    rgb = layers(
        depth,
        [
            (0.0, paint(0.80, 0.42, 0.10)),
            (0.04, paint(0.92, 0.62, 0.18)),
            (0.45, paint(0.94, 0.60, 0.16)),
            (1.0, paint(0.86, 0.44, 0.10)),
        ],
    )
    bent = points + 0.15 * np.stack([fractal(points, 3.0, seed + i, 2) for i in range(3)], 1)
    strand = np.abs(fractal(bent * [1.0, 1.0, 0.4], 6.0, seed + 4, 2))
    inner = smoothstep((depth - 0.45) / 0.2)
    rgb = mix(rgb, paint(0.97, 0.76, 0.36), 0.55 * inner * np.exp(-((strand / 0.10) ** 2)))
    rgb = rgb * (1 + 0.04 * fractal(points, 15.0, seed + 5, 2))[:, None]
    return rgb.astype(np.float32), np.zeros(len(points), np.int64)


TINTED = frozenset({"plain", "grain", "stone", "foam", "clear", "chocolate"})
"""Presets that take the colour of the object's skin."""


def _grey(tone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness about one [n] as a grey."""
    rgb = np.repeat((GREY * tone)[:, None], 3, axis=1).astype(np.float32)
    return rgb, np.zeros(len(tone), np.int64)
