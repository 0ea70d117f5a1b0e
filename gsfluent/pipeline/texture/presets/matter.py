"""Presets of wood, stone, bone and other matter."""

from __future__ import annotations

import numpy as np

from gsfluent.pipeline.texture.presets.tools import layers, mix, paint
from gsfluent.pipeline.texture.volume.domain import smoothstep
from gsfluent.pipeline.texture.volume.noise import cells, fractal, value_noise


def wood(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Growth rings about a wandering pith, fibres along the axis, rays, darker heart."""
    own = np.random.default_rng([seed, 8])
    x, y, z = points.T
    # everything varies slowly along the grain
    along = np.stack([0 * z, 0 * z, 0.35 * z], 1)
    x = x + 0.10 * fractal(along, 1.0, seed, 2) + own.uniform(-0.15, 0.15)
    y = y + 0.10 * fractal(along + 5.3, 1.0, seed, 2) + own.uniform(-0.15, 0.15)
    angle = np.arctan2(y, x)
    radius = np.hypot(x, y)
    lobes = np.stack([np.cos(angle), np.sin(angle), 0.25 * z], 1)
    radius = radius * (1 + 0.05 * fractal(lobes, 0.9, seed + 1, 2))
    radius = radius + 0.02 * fractal(points * [1.0, 1.0, 0.15], 2.5, seed + 2, 2)
    # years differ in width
    flat = np.stack([radius, 0 * radius, 0 * radius], 1)
    ring = 6.5 * (radius + 0.11 * fractal(flat, 1.7, seed + 3, 2))
    year = np.floor(ring)
    phase = ring - year
    late = smoothstep((phase - 0.25) / 0.65) ** 1.5 * smoothstep((1.0 - phase) / 0.10)
    tone = value_noise(np.stack([year, 0 * ring, 0 * ring], 1) + 0.5, 1.0, seed + 4)
    rgb = mix(paint(0.88, 0.71, 0.49), paint(0.60, 0.37, 0.19), late * (0.72 + 0.28 * tone))
    heart = smoothstep((0.55 - radius) / 0.25)
    rgb = mix(rgb, rgb * paint(0.93, 0.85, 0.78), heart)
    rgb = mix(rgb, paint(0.45, 0.27, 0.14), smoothstep((0.045 - radius) / 0.02))
    fibre = fractal(points * [1.0, 1.0, 0.05], 14.0, seed + 5, 3)
    # rays: thin radial blades, short along the grain
    blade = fractal(np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), 1.6 * z], 1), 1.0, seed + 6)
    ray = smoothstep((0.10 - np.abs(blade)) / 0.08) * smoothstep((radius - 0.08) / 0.1)
    rgb = rgb * (1 + 0.07 * fibre)[:, None]
    rgb = mix(rgb, paint(0.93, 0.79, 0.58), 0.28 * ray)
    return rgb, np.zeros(len(points), np.int64)


def marble(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """White stone with clouds, long grey veins and a net of finer ones; no layers."""
    warp = np.stack([fractal(points, 1.1, seed + i, 3) for i in range(3)], 1)
    bent = points + 0.30 * warp
    cloud = fractal(bent, 1.6, seed + 4, 4)
    rgb = mix(paint(0.94, 0.93, 0.91), paint(0.74, 0.75, 0.78), 0.45 + 0.6 * cloud)
    # the long ones lean one way, as beds do
    lean = bent * [1.0, 0.55, 0.8]
    systems = ((lean, 1.7, 0.045, 0.85), (bent, 2.9, 0.045, 0.5), (bent, 5.5, 0.05, 0.3))
    for k, (place, frequency, width, strength) in enumerate(systems):
        sheet = np.abs(fractal(place, frequency, seed + 11 + 7 * k, 3))
        swell = 0.55 + 0.45 * fractal(points, 2.3, seed + 31 + k, 2)
        vein = np.exp(-((sheet / (width * np.clip(swell, 0.15, 1.5))) ** 2))
        halo = np.exp(-((sheet / (5.0 * width)) ** 2))
        fade = smoothstep(0.55 + 0.9 * fractal(points, 1.4, seed + 20 + k, 2))
        rgb = mix(rgb, paint(0.62, 0.64, 0.68), 0.5 * strength * halo * fade)
        rgb = mix(rgb, paint(0.33, 0.34, 0.38), strength * vein * fade)
    rgb = rgb * (1 + 0.015 * fractal(points, 22.0, seed + 40, 2))[:, None]
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
    return _spongy(points, depth, seed, paint(0.66, 0.42, 0.32))


def dry_bone(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Bone of a collection: as ``bone``, its pores empty and brown with dust."""
    return _spongy(points, depth, seed, paint(0.58, 0.47, 0.33))


def _spongy(
    points: np.ndarray, depth: np.ndarray, seed: int, pores: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ivory cortex over spongy bone whose pores have one colour [3]."""
    rgb = np.broadcast_to(paint(0.92, 0.87, 0.75), (len(points), 3))
    rgb = rgb * (1 + 0.03 * fractal(points, 8.0, seed, 2))[:, None].astype(np.float32)
    pore = cells(points, 9.0, seed + 1)
    wall = pore.second - pore.first
    spongy = smoothstep((depth - 0.22) / 0.12)
    rgb = mix(rgb, pores, spongy * smoothstep((wall - 0.16) / 0.10))
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
