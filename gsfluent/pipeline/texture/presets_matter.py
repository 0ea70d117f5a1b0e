"""Presets of wood, stone, bone and other matter."""

from __future__ import annotations

import numpy as np

from .domain import smoothstep
from .noise import cells, fractal, value_noise
from .preset_tools import layers, mix, paint


def wood(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Growth rings about a wandering pith, fibres along the axis, faint rays."""
    x, y, z = points.T
    bend = np.stack([0.4 * z + 3.1, 0 * z, 0 * z + seed], 1)
    x = x + 0.12 * value_noise(bend, 1.0, seed)
    y = y + 0.12 * value_noise(bend + 9.0, 1.0, seed)
    radius = np.hypot(x, y) + 0.035 * fractal(points * [1.5, 1.5, 0.3], 1.5, seed + 1)
    ring = radius * 11.0
    phase = ring - np.floor(ring)
    late = smoothstep((phase - 0.55) / 0.4) * smoothstep((1.0 - phase) / 0.06)
    tone = value_noise(np.stack([np.floor(ring), 0 * ring, 0 * ring], 1), 1.0, seed + 2)
    rgb = mix(
        np.broadcast_to(paint(0.85, 0.66, 0.43), (len(points), 3)),
        paint(0.56, 0.34, 0.17),
        late * (0.75 + 0.25 * tone),
    )
    fibre = fractal(points * [1.0, 1.0, 0.06], 24.0, seed + 3, 2)
    angle = np.arctan2(y, x)
    ray = value_noise(np.stack([angle * 18, radius * 1.2, z * 3], 1), 1.0, seed + 4)
    rgb = rgb * (1 + 0.06 * fibre + 0.05 * (ray > 0.62))[:, None]
    return rgb, np.zeros(len(points), np.int64)


def marble(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """White stone with clouds and two systems of grey veins; no layers."""
    warp = np.stack([fractal(points, 1.3, seed + i, 3) for i in range(3)], 1)
    bent = points + 0.35 * warp
    cloud = fractal(bent, 1.6, seed + 4)
    rgb = mix(
        np.broadcast_to(paint(0.93, 0.92, 0.90), (len(points), 3)),
        paint(0.76, 0.77, 0.79),
        0.5 + 0.5 * cloud,
    )
    for k, (frequency, width, strength) in enumerate(((1.1, 0.035, 0.8), (2.6, 0.03, 0.45))):
        sheet = np.abs(fractal(bent, frequency, seed + 11 + k, 3))
        vein = np.exp(-((sheet / width) ** 2))
        fade = 0.5 + 0.5 * value_noise(points, 1.7, seed + 20 + k)
        rgb = mix(rgb, paint(0.36, 0.37, 0.41), strength * vein * fade)
    return rgb, np.zeros(len(points), np.int64)


def concrete(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey paste with angular gravel of two sizes (labelled) and small air voids."""
    rgb = np.broadcast_to(paint(0.62, 0.61, 0.58), (len(points), 3))
    rgb = rgb * (1 + 0.08 * fractal(points, 14.0, seed, 2))[:, None].astype(np.float32)
    label = np.zeros(len(points), np.int64)
    for frequency, share in ((3.2, 0.85), (7.0, 0.6)):
        stone = cells(points + 0.03 * value_noise(points, 9.0, seed)[:, None], frequency, seed + 3)
        chosen = (stone.second - stone.first > 0.16) & (stone.random(1) < share) & (label == 0)
        chosen &= stone.first < 0.48
        tone = stone.random(2)[:, None]
        color = paint(0.42, 0.41, 0.40) + tone * paint(0.34, 0.29, 0.24)
        color = color * (1 + 0.06 * value_noise(points, 18.0, seed + 5))[:, None]
        rgb = np.where(chosen[:, None], color, rgb)
        # the two sizes share the lattice's seed: the frequency keeps their keys apart
        label[chosen] = stone.key[chosen].astype(np.int64) * 16 + int(frequency)
    return rgb, label


def bone(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Dense ivory cortex over spongy bone with reddish marrow in the pores."""
    rgb = np.broadcast_to(paint(0.92, 0.87, 0.75), (len(points), 3))
    rgb = rgb * (1 + 0.03 * fractal(points, 8.0, seed, 2))[:, None].astype(np.float32)
    pore = cells(points, 9.0, seed + 1)
    wall = pore.second - pore.first
    spongy = smoothstep((depth - 0.22) / 0.12)
    rgb = mix(rgb, paint(0.66, 0.42, 0.32), spongy * smoothstep((wall - 0.16) / 0.10))
    return rgb, np.zeros(len(points), np.int64)


def jelly(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Clear red gel: darker with depth, a few pale bubbles."""
    rgb = layers(depth, [(0.0, paint(0.88, 0.16, 0.22)), (1.0, paint(0.62, 0.03, 0.10))])
    rgb = rgb * (1 + 0.04 * fractal(points, 2.5, seed, 2))[:, None]
    bubble = cells(points, 5.0, seed + 1)
    radius = 0.10 + 0.12 * bubble.random(1)
    there = (bubble.random(2) < 0.3) & (bubble.first < radius)
    rgb = np.where(there[:, None], mix(rgb, paint(0.98, 0.62, 0.62), np.full(len(rgb), 0.6)), rgb)
    return rgb, np.zeros(len(points), np.int64)


def stuffing(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """White polyester wadding under a thin cloth."""
    bent = points + 0.2 * np.stack([fractal(points, 3.0, seed + i, 2) for i in range(3)], 1)
    strand = fractal(bent * [1.0, 0.35, 1.0], 11.0, seed + 5, 3)
    rgb = np.broadcast_to(paint(0.90, 0.89, 0.86), (len(points), 3))
    rgb = rgb * (1 + 0.09 * strand + 0.05 * fractal(points, 2.0, seed + 6, 2))[:, None]
    return rgb.astype(np.float32), np.zeros(len(points), np.int64)
