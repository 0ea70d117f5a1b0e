"""Presets of things to eat."""

from __future__ import annotations

import numpy as np

from .domain import smoothstep
from .noise import cells, fractal, value_noise
from .preset_tools import layers, mix, paint


def watermelon(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Striped skin, pale rind, red flesh with pale fibres, dark seeds in a ring."""
    wobble = 0.015 * value_noise(points, 4.0, seed)
    t = depth + wobble
    rgb = layers(
        t,
        [
            (0.0, paint(0.13, 0.30, 0.10)),
            (0.03, paint(0.30, 0.48, 0.18)),
            (0.06, paint(0.74, 0.82, 0.55)),
            (0.13, paint(0.93, 0.93, 0.80)),
            (0.20, paint(0.96, 0.66, 0.58)),
            (0.28, paint(0.90, 0.29, 0.26)),
            (0.60, paint(0.86, 0.16, 0.17)),
            (1.0, paint(0.89, 0.24, 0.24)),
        ],
    )
    flesh = smoothstep((t - 0.18) / 0.12)
    patches = fractal(points, 2.2, seed + 3) * flesh
    rgb = mix(rgb, paint(0.97, 0.50, 0.46), 0.45 * np.clip(patches, 0, 1))
    rgb = mix(rgb, paint(0.70, 0.07, 0.10), 0.5 * np.clip(-patches, 0, 1))
    warp = np.stack([fractal(points, 2.5, seed + 4 + i, 2) for i in range(3)], 1)
    fibre = np.abs(fractal(points + 0.25 * warp, 3.0, seed + 5, 2))
    rgb = mix(rgb, paint(0.98, 0.70, 0.64), 0.4 * flesh * np.exp(-((fibre / 0.06) ** 2)))
    grain = value_noise(points, 22.0, seed + 9)
    rgb = rgb * (1 + 0.05 * grain * flesh)[:, None]
    return _seeds(points, depth, rgb, seed + 11, (0.32, 0.68), 0.34, (0.10, 0.055))


def _seeds(
    points: np.ndarray,
    depth: np.ndarray,
    rgb: np.ndarray,
    seed: int,
    ring: tuple[float, float],
    pitch: float,
    size: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Dark ellipsoidal seeds on a jittered lattice, long axis towards the core."""
    found = cells(points, 1.0 / pitch, seed, jitter=0.6)
    delta = found.offset * pitch
    center = points - delta
    # depth varies slowly: a seed belongs to the ring if its own centre does
    radial = center / np.maximum(np.linalg.norm(center, axis=1, keepdims=True), 1e-6)
    along = (delta * radial).sum(1)
    across = np.linalg.norm(delta - along[:, None] * radial, axis=1)
    center_depth = depth + along
    present = (center_depth > ring[0]) & (center_depth < ring[1]) & (found.random(5) < 0.85)
    r = np.sqrt((along / size[0]) ** 2 + (across / size[1]) ** 2)
    inside = present & (r < 1.0)
    rim = present & (r >= 1.0) & (r < 1.35)
    rgb = np.where(rim[:, None], mix(rgb, paint(0.95, 0.75, 0.62), np.full(len(r), 0.6)), rgb)
    shine = smoothstep((0.5 - r) / 0.5)
    body = mix(np.broadcast_to(paint(0.09, 0.05, 0.03), rgb.shape), paint(0.27, 0.16, 0.09), shine)
    rgb = np.where(inside[:, None], body, rgb)
    return rgb, np.where(inside, found.key.astype(np.int64) + 1, 0)


def apple(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Thin red skin, cream flesh, five carpels with brown seeds around the axis."""
    rgb = layers(
        depth,
        [
            (0.0, paint(0.70, 0.10, 0.10)),
            (0.025, paint(0.80, 0.35, 0.22)),
            (0.05, paint(0.90, 0.88, 0.62)),
            (0.15, paint(0.97, 0.94, 0.78)),
            (1.0, paint(0.96, 0.92, 0.74)),
        ],
    )
    grain = fractal(points, 12.0, seed, 2)
    rgb = rgb * (1 + 0.03 * grain)[:, None]
    x, y, z = points.T
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    core = 0.40 * np.sqrt(np.clip(1 - (z / 0.55) ** 2, 0, 1))
    line = np.abs(radius - core - 0.02 * value_noise(points, 5.0, seed + 1))
    rgb = mix(rgb, paint(0.72, 0.78, 0.45), 0.6 * np.exp(-((line / 0.015) ** 2)) * (core > 0.02))
    sector = (angle + 0.15 * seed) * 5 / (2 * np.pi)
    local = (sector - np.round(sector)) * 2 * np.pi / 5
    u, v = radius * np.cos(local), radius * np.sin(local)
    carpel = ((u - 0.17) / 0.13) ** 2 + (v / 0.045) ** 2 + (z / 0.28) ** 2
    rgb = np.where((carpel < 1)[:, None], paint(0.62, 0.52, 0.28), rgb)
    rgb = np.where(((carpel >= 1) & (carpel < 1.5))[:, None], paint(0.88, 0.83, 0.58), rgb)
    pip = ((u - 0.16) / 0.065) ** 2 + (v / 0.032) ** 2 + ((z - 0.04) / 0.11) ** 2
    label = np.where(pip < 1, 1 + (np.round(sector).astype(int) % 5), 0).astype(np.int64)
    rgb = np.where((pip < 1)[:, None], paint(0.24, 0.11, 0.05), rgb)
    return rgb, label


def orange(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Peel, white albedo, segments with juice vesicles between membranes, pith on the axis."""
    x, y, z = points.T
    radius = np.hypot(x, y)
    angle = np.arctan2(y, x) + 0.1 * value_noise(points, 2.0, seed) + 0.13 * (1 + seed % 7)
    segments = 10
    sector = angle * segments / (2 * np.pi)
    gap = np.abs(sector - np.round(sector)) * 2 * np.pi / segments * radius
    stretched = np.stack([radius * 0.45, np.round(sector) * 3.0 + sector, z * 0.9], 1)
    sac = cells(stretched, 7.0, seed + 1)
    pulp = mix(
        np.broadcast_to(paint(0.98, 0.62, 0.14), (len(points), 3)),
        paint(0.93, 0.46, 0.05),
        sac.random(2),
    )
    pulp = mix(pulp, paint(1.0, 0.80, 0.42), smoothstep((0.14 - sac.second + sac.first) / 0.14))
    membrane = smoothstep((0.025 - gap) / 0.015)
    rgb = mix(pulp, paint(0.98, 0.86, 0.62), 0.85 * membrane)
    axis = 0.10 + 0.02 * value_noise(points, 3.0, seed + 2)
    rgb = mix(rgb, paint(0.97, 0.92, 0.80), smoothstep((axis - radius) / 0.04 + 0.5))
    peel = layers(
        depth,
        [
            (0.0, paint(0.93, 0.47, 0.05)),
            (0.05, paint(0.98, 0.62, 0.16)),
            (0.075, paint(0.99, 0.93, 0.80)),
            (1.0, paint(0.98, 0.93, 0.82)),
        ],
    )
    rgb = mix(peel, rgb, smoothstep((depth - 0.13) / 0.02))
    return rgb, np.zeros(len(points), np.int64)


def bread(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Brown crust, cream crumb with pores of two sizes (dark, seen from above)."""
    rgb = layers(
        depth + 0.02 * value_noise(points, 6.0, seed),
        [
            (0.0, paint(0.50, 0.26, 0.10)),
            (0.05, paint(0.72, 0.46, 0.22)),
            (0.12, paint(0.90, 0.79, 0.58)),
            (1.0, paint(0.94, 0.87, 0.70)),
        ],
    )
    rgb = rgb * (1 + 0.06 * fractal(points, 9.0, seed + 1))[:, None]
    flat = points * [1.0, 1.0, 1.25]
    crumb = smoothstep((depth - 0.08) / 0.06)
    for frequency, size, dark in ((5.0, 0.30, 0.62), (11.0, 0.30, 0.75)):
        pore = cells(flat, frequency, seed + int(frequency))
        radius = size * (0.35 + pore.random(3))
        hole = smoothstep((radius - pore.first) / 0.12) * crumb * (pore.random(4) < 0.7)
        rgb = mix(rgb, rgb * np.float32(dark), hole)
    return rgb, np.zeros(len(points), np.int64)


def cake(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Sponge with two layers of cream by height (z), icing all round."""
    z = points[:, 2] + 0.05 * fractal(points * [1.0, 1.0, 0.4], 1.5, seed, 2)
    base = 0.05 * np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    sponge = mix(
        paint(0.86, 0.66, 0.36), paint(0.76, 0.54, 0.27), 0.5 + 0.6 * fractal(points, 6.0, seed + 1)
    )
    for frequency, share in ((7.0, 0.5), (12.0, 0.6), (20.0, 0.7)):
        pore = cells(points, frequency, seed + int(frequency))
        radius = 0.22 + 0.22 * pore.random(3)
        hole = smoothstep((radius - pore.first) / 0.15) * (pore.random(4) < share)
        sponge = mix(sponge, sponge * np.float32(0.66), hole)
    cream = mix(
        paint(0.97, 0.93, 0.85), paint(0.93, 0.87, 0.77), 0.5 + 0.5 * fractal(points, 5.0, seed + 2)
    )
    rgb = sponge
    for middle, offset in zip((-0.33, 0.33), base, strict=True):
        away = np.abs(z - middle - offset)
        rgb = mix(rgb, cream, smoothstep((0.10 - away) / 0.03))
    icing = depth + 0.02 * value_noise(points, 4.0, seed + 3)
    rgb = mix(rgb, cream, smoothstep((0.16 - icing) / 0.03))
    return rgb, np.zeros(len(points), np.int64)
