"""Presets of things to eat."""

from __future__ import annotations

import numpy as np

from gsfluent.pipeline.texture.presets.tools import layers, mix, paint
from gsfluent.pipeline.texture.volume.domain import smoothstep
from gsfluent.pipeline.texture.volume.noise import cells, fractal, value_noise


def watermelon(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Striped skin, pale rind, red flesh with pale fibres, dark seeds in a ring."""
    wobble = 0.015 * fractal(points, 3.0, seed, 2)
    t = depth + wobble
    rgb = layers(
        t,
        [
            (0.0, paint(0.25, 0.44, 0.17)),
            (0.04, paint(0.36, 0.54, 0.22)),
            (0.07, paint(0.74, 0.82, 0.55)),
            (0.13, paint(0.93, 0.93, 0.80)),
            (0.20, paint(0.96, 0.66, 0.58)),
            (0.28, paint(0.90, 0.29, 0.26)),
            (0.60, paint(0.86, 0.16, 0.17)),
            (1.0, paint(0.89, 0.24, 0.24)),
        ],
    )
    angle = np.arctan2(points[:, 1], points[:, 0]) + 0.25 * fractal(points, 2.5, seed + 1, 2)
    stripe = smoothstep((np.cos(9.0 * angle) + 0.2) / 0.5) * smoothstep((0.05 - t) / 0.02)
    rgb = mix(rgb, paint(0.08, 0.21, 0.08), 0.9 * stripe)
    flesh = smoothstep((t - 0.18) / 0.12)
    patches = fractal(points, 2.2, seed + 3) * flesh
    rgb = mix(rgb, paint(0.97, 0.50, 0.46), 0.45 * np.clip(patches, 0, 1))
    rgb = mix(rgb, paint(0.70, 0.07, 0.10), 0.5 * np.clip(-patches, 0, 1))
    warp = np.stack([fractal(points, 2.5, seed + 4 + i, 2) for i in range(3)], 1)
    fibre = np.abs(fractal(points + 0.25 * warp, 2.6, seed + 5, 2))
    bundle = smoothstep(0.5 + fractal(points, 2.0, seed + 8, 1))
    rgb = mix(rgb, paint(0.98, 0.66, 0.60), 0.45 * flesh * bundle * np.exp(-((fibre / 0.07) ** 2)))
    grain = fractal(points, 16.0, seed + 9, 2)
    rgb = rgb * (1 + 0.05 * grain * flesh)[:, None]
    return _seeds(points, depth, rgb, seed + 11, (0.30, 0.66), 0.17, (0.058, 0.034))


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
    own = np.random.default_rng([seed, 5])
    segments = int(own.integers(9, 12))
    x, y, z = points.T
    # the core is never quite in the middle, nor straight
    x = x - 0.05 * own.uniform(-1, 1) - 0.03 * fractal(np.stack([0 * z, 0 * z, z], 1), 1.0, seed)
    y = (
        y
        - 0.05 * own.uniform(-1, 1)
        - 0.03 * fractal(np.stack([0 * z + 7, 0 * z, z], 1), 1.0, seed)
    )
    radius = np.hypot(x, y)
    # and the segments wind a little, so that no flat cut follows a membrane for long
    turn = own.uniform(0, 2 * np.pi) + own.choice([-0.3, 0.3]) * z
    turn = turn + 0.16 * fractal(points, 1.3, seed + 1, 2)
    sector = (np.arctan2(y, x) + turn) * segments / (2 * np.pi)
    # uneven widths: a slow wave on the way round, closed after one turn
    phase = 2 * np.pi * sector / segments
    sector = sector + 0.22 * np.sin(2 * phase + own.uniform(0, 6)) + 0.12 * np.sin(3 * phase)
    nearest = np.round(sector)
    side = (sector - nearest) * 2 * np.pi / segments * radius
    segment = np.floor(sector)
    middle = (sector - segment - 0.5) * 2 * np.pi / segments * radius
    number = np.mod(segment, segments)
    # vesicles: spindles that point at the axis, wider outside
    spindle = np.stack([0.34 * radius + 0.10 * np.abs(z), middle + 7.0 * number, 0.8 * z], 1)
    sac = cells(spindle + 0.015 * fractal(points, 6.0, seed + 2, 1)[:, None], 11.0, seed + 3)
    rgb = mix(paint(0.98, 0.60, 0.13), paint(0.94, 0.46, 0.06), sac.random(2))
    rgb = mix(rgb, paint(1.0, 0.72, 0.30), 0.35 * smoothstep((0.35 - sac.first) / 0.3))
    wall = smoothstep((0.10 - sac.second + sac.first) / 0.10)
    rgb = mix(rgb, paint(0.99, 0.78, 0.40), 0.6 * wall)
    skin = 0.013 + 0.006 * fractal(points, 5.0, seed + 4, 1)
    rgb = mix(rgb, paint(0.98, 0.87, 0.64), 0.9 * smoothstep((skin - np.abs(side)) / 0.015 + 0.5))
    # the pith reaches a little way into the membranes: a star, not a disc
    core = 0.075 + 0.03 * fractal(points, 3.0, seed + 5, 2)
    core = core + 0.05 * smoothstep((0.06 - np.abs(side)) / 0.05)
    pith = mix(
        paint(0.98, 0.94, 0.83), paint(0.95, 0.87, 0.70), 0.5 + fractal(points, 9.0, seed + 6)
    )
    rgb = mix(rgb, pith, smoothstep((core - radius) / 0.04 + 0.5))
    albedo = 0.125 + 0.025 * fractal(points, 2.5, seed + 7, 2)
    rgb = mix(pith, rgb, smoothstep((depth - albedo) / 0.02 + 0.5))
    peel = layers(depth, [(0.0, paint(0.91, 0.45, 0.05)), (0.05, paint(0.97, 0.60, 0.15))])
    gland = cells(points, 15.0, seed + 8)
    dark = smoothstep((0.28 - gland.first) / 0.1)
    peel = mix(peel, paint(0.82, 0.38, 0.04), 0.6 * dark)
    rgb = mix(rgb, peel, smoothstep((0.06 - depth) / 0.02 + 0.5))
    return rgb, np.zeros(len(points), np.int64)


def bread(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Brown crust, cream crumb, pores from hardly seen to large (dark, seen from above)."""
    own = np.random.default_rng([seed, 6])
    toast, airy = own.uniform(-1, 1, 2)
    t = depth * (1 - 0.1 * toast) + 0.025 * fractal(points, 3.0, seed, 3)
    rgb = layers(
        t,
        [
            (0.0, paint(0.46, 0.22, 0.08)),
            (0.04, paint(0.62, 0.35, 0.14)),
            (0.08, paint(0.78, 0.56, 0.31)),
            (0.14, paint(0.90, 0.79, 0.58)),
            (0.30, paint(0.93, 0.86, 0.69)),
            (1.0, paint(0.94, 0.87, 0.71)),
        ],
    )
    rgb = (
        rgb
        * (1 + 0.05 * fractal(points, 5.0, seed + 1) + 0.05 * fractal(points, 17.0, seed + 2))[
            :, None
        ]
    )
    warp = np.stack([fractal(points, 5.0, seed + 3 + i, 2) for i in range(3)], 1)
    bent = (points + 0.035 * warp) * [1.0, 1.0, 1.2]
    crumb = smoothstep((t - 0.09) / 0.06)
    open_ = smoothstep((t - 0.12) / 0.25)  # large holes keep away from the crust
    # size over lattice pitch, how many of the sites are taken, how dark the bottom is
    for pitch, share, dark in (
        (0.36, 0.45, 0.54),
        (0.19, 0.55, 0.60),
        (0.11, 0.65, 0.68),
        (0.065, 0.75, 0.76),
    ):
        pore = cells(bent, 1.0 / pitch, seed + int(1 / pitch), jitter=0.9)
        size = (0.17 + 0.28 * pore.random(3) ** 2) * (1 + 0.1 * airy)
        where = crumb if pitch < 0.15 else open_
        taken = where * (pore.random(4) < share)
        shadow = smoothstep((size - pore.first) / 0.14)
        rim = smoothstep((0.1 - np.abs(pore.first - size - 0.04)) / 0.08)
        rgb = mix(rgb, paint(0.98, 0.93, 0.80), 0.35 * rim * taken)
        # deeper in the middle
        floor = np.float32(dark) + np.float32(0.14) * smoothstep(pore.first / 0.4)[:, None]
        rgb = mix(rgb, rgb * floor * paint(1.0, 0.96, 0.88), shadow * taken)
    return rgb, np.zeros(len(points), np.int64)


def cake(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Three sponges with cream and jam between, by height (z), and icing all round."""
    own = np.random.default_rng([seed, 7])
    z = points[:, 2] + 0.05 * fractal(points * [1.0, 1.0, 0.4], 1.2, seed, 3)
    tint = 0.5 + 0.5 * fractal(points, 4.0, seed + 1) + 0.1 * own.uniform(-1, 1)
    rgb = mix(paint(0.89, 0.70, 0.39), paint(0.80, 0.58, 0.29), tint)
    rgb = rgb * (1 + 0.07 * fractal(points, 15.0, seed + 2, 2))[:, None]
    bent = points * [1.0, 1.0, 1.15] + 0.03 * fractal(points, 7.0, seed + 3, 2)[:, None]
    for pitch, share, dark in ((0.22, 0.25, 0.66), (0.11, 0.45, 0.72), (0.06, 0.6, 0.80)):
        pore = cells(bent, 1.0 / pitch, seed + int(1 / pitch), jitter=0.9)
        size = 0.14 + 0.26 * pore.random(3) ** 2
        hole = smoothstep((size - pore.first) / 0.14) * (pore.random(4) < share)
        rgb = mix(rgb, rgb * np.float32(dark), hole)
    cream = mix(
        paint(0.98, 0.95, 0.89), paint(0.93, 0.88, 0.79), 0.4 + 0.5 * fractal(points, 3.0, seed + 4)
    )
    jam = mix(
        paint(0.70, 0.10, 0.14), paint(0.50, 0.04, 0.08), 0.5 + fractal(points, 8.0, seed + 5, 2)
    )
    places = np.array([-0.32, 0.32]) + 0.04 * own.uniform(-1, 1, 2)
    for k, place in enumerate(places):
        thick = 0.085 + 0.02 * fractal(points, 3.0, seed + 6 + k, 2)
        away = z - place
        rgb = mix(rgb, cream, smoothstep((thick - np.abs(away)) / 0.02 + 0.5))
        smear = 0.035 + 0.025 * fractal(points, 4.0, seed + 8 + k, 2)
        rgb = mix(rgb, jam, smoothstep((smear - np.abs(away + thick + 0.01)) / 0.02 + 0.5))
    thickness = 0.14 + 0.03 * fractal(points, 2.5, seed + 10, 2)
    rgb = mix(rgb, cream, smoothstep((thickness - depth) / 0.025 + 0.5))
    return rgb, np.zeros(len(points), np.int64)
