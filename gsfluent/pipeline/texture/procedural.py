"""Presets: interiors as functions of position and depth, no photograph needed.

Every preset is ``f(points, depth, seed) -> (rgb, label)`` with points [n, 3] centred on the object,
z along its own axis, and depth [n], both in units of the largest depth (so depth runs 0..1 from
skin to core). They are point functions: any resolution, any oblique plane, no seams.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsfluent.errors import InputError

from .domain import InteriorDomain, InteriorTexture, axis_frame, smoothstep
from .noise import cells, fractal, value_noise

__all__ = ["PRESETS", "preset_names", "procedural_texture"]

Preset = Callable[[np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]]


def _rgb(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def _mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    result: np.ndarray = a + (b - a) * np.clip(t, 0.0, 1.0)[:, None]
    return result


def _layers(depth: np.ndarray, stops: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Piecewise linear colour over depth."""
    position = [s[0] for s in stops]
    table = np.stack([s[1] for s in stops])
    return np.stack([np.interp(depth, position, table[:, c]) for c in range(3)], 1).astype(
        np.float32
    )


def watermelon(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Striped skin, pale rind, red flesh with pale fibres, dark seeds in a ring."""
    wobble = 0.015 * value_noise(points, 4.0, seed)
    t = depth + wobble
    rgb = _layers(
        t,
        [
            (0.0, _rgb(0.13, 0.30, 0.10)),
            (0.03, _rgb(0.30, 0.48, 0.18)),
            (0.06, _rgb(0.74, 0.82, 0.55)),
            (0.13, _rgb(0.93, 0.93, 0.80)),
            (0.20, _rgb(0.96, 0.66, 0.58)),
            (0.28, _rgb(0.90, 0.29, 0.26)),
            (0.60, _rgb(0.86, 0.16, 0.17)),
            (1.0, _rgb(0.89, 0.24, 0.24)),
        ],
    )
    flesh = smoothstep((t - 0.18) / 0.12)
    patches = fractal(points, 2.2, seed + 3) * flesh
    rgb = _mix(rgb, _rgb(0.97, 0.50, 0.46), 0.45 * np.clip(patches, 0, 1))
    rgb = _mix(rgb, _rgb(0.70, 0.07, 0.10), 0.5 * np.clip(-patches, 0, 1))
    warp = np.stack([fractal(points, 2.5, seed + 4 + i, 2) for i in range(3)], 1)
    fibre = np.abs(fractal(points + 0.25 * warp, 3.0, seed + 5, 2))
    rgb = _mix(rgb, _rgb(0.98, 0.70, 0.64), 0.4 * flesh * np.exp(-((fibre / 0.06) ** 2)))
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
    rgb = np.where(rim[:, None], _mix(rgb, _rgb(0.95, 0.75, 0.62), np.full(len(r), 0.6)), rgb)
    shine = smoothstep((0.5 - r) / 0.5)
    body = _mix(np.broadcast_to(_rgb(0.09, 0.05, 0.03), rgb.shape), _rgb(0.27, 0.16, 0.09), shine)
    rgb = np.where(inside[:, None], body, rgb)
    label = np.zeros(len(points), np.int32)
    _, number = np.unique(found.key[inside], return_inverse=True)
    label[inside] = 1 + number.reshape(-1)
    return rgb, label


def apple(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Thin red skin, cream flesh, five carpels with brown seeds around the axis."""
    rgb = _layers(
        depth,
        [
            (0.0, _rgb(0.70, 0.10, 0.10)),
            (0.025, _rgb(0.80, 0.35, 0.22)),
            (0.05, _rgb(0.90, 0.88, 0.62)),
            (0.15, _rgb(0.97, 0.94, 0.78)),
            (1.0, _rgb(0.96, 0.92, 0.74)),
        ],
    )
    grain = fractal(points, 12.0, seed, 2)
    rgb = rgb * (1 + 0.03 * grain)[:, None]
    x, y, z = points.T
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    core = 0.40 * np.sqrt(np.clip(1 - (z / 0.55) ** 2, 0, 1))
    line = np.abs(radius - core - 0.02 * value_noise(points, 5.0, seed + 1))
    rgb = _mix(rgb, _rgb(0.72, 0.78, 0.45), 0.6 * np.exp(-((line / 0.015) ** 2)) * (core > 0.02))
    sector = (angle + 0.15 * seed) * 5 / (2 * np.pi)
    local = (sector - np.round(sector)) * 2 * np.pi / 5
    u, v = radius * np.cos(local), radius * np.sin(local)
    carpel = ((u - 0.17) / 0.13) ** 2 + (v / 0.045) ** 2 + (z / 0.28) ** 2
    rgb = np.where((carpel < 1)[:, None], _rgb(0.62, 0.52, 0.28), rgb)
    rgb = np.where(((carpel >= 1) & (carpel < 1.5))[:, None], _rgb(0.88, 0.83, 0.58), rgb)
    pip = ((u - 0.16) / 0.065) ** 2 + (v / 0.032) ** 2 + ((z - 0.04) / 0.11) ** 2
    label = np.where(pip < 1, 1 + (np.round(sector).astype(int) % 5), 0).astype(np.int32)
    rgb = np.where((pip < 1)[:, None], _rgb(0.24, 0.11, 0.05), rgb)
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
    pulp = _mix(
        np.broadcast_to(_rgb(0.98, 0.62, 0.14), (len(points), 3)),
        _rgb(0.93, 0.46, 0.05),
        sac.random(2),
    )
    pulp = _mix(pulp, _rgb(1.0, 0.80, 0.42), smoothstep((0.14 - sac.second + sac.first) / 0.14))
    membrane = smoothstep((0.025 - gap) / 0.015)
    rgb = _mix(pulp, _rgb(0.98, 0.86, 0.62), 0.85 * membrane)
    axis = 0.10 + 0.02 * value_noise(points, 3.0, seed + 2)
    rgb = _mix(rgb, _rgb(0.97, 0.92, 0.80), smoothstep((axis - radius) / 0.04 + 0.5))
    peel = _layers(
        depth,
        [
            (0.0, _rgb(0.93, 0.47, 0.05)),
            (0.05, _rgb(0.98, 0.62, 0.16)),
            (0.075, _rgb(0.99, 0.93, 0.80)),
            (1.0, _rgb(0.98, 0.93, 0.82)),
        ],
    )
    rgb = _mix(peel, rgb, smoothstep((depth - 0.13) / 0.02))
    return rgb, np.zeros(len(points), np.int32)


def bread(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Brown crust, cream crumb with pores of two sizes (dark, seen from above)."""
    rgb = _layers(
        depth + 0.02 * value_noise(points, 6.0, seed),
        [
            (0.0, _rgb(0.50, 0.26, 0.10)),
            (0.05, _rgb(0.72, 0.46, 0.22)),
            (0.12, _rgb(0.90, 0.79, 0.58)),
            (1.0, _rgb(0.94, 0.87, 0.70)),
        ],
    )
    rgb = rgb * (1 + 0.06 * fractal(points, 9.0, seed + 1))[:, None]
    flat = points * [1.0, 1.0, 1.25]
    crumb = smoothstep((depth - 0.08) / 0.06)
    for frequency, size, dark in ((5.0, 0.30, 0.62), (11.0, 0.30, 0.75)):
        pore = cells(flat, frequency, seed + int(frequency))
        radius = size * (0.35 + pore.random(3))
        hole = smoothstep((radius - pore.first) / 0.12) * crumb * (pore.random(4) < 0.7)
        rgb = _mix(rgb, rgb * np.float32(dark), hole)
    return rgb, np.zeros(len(points), np.int32)


def wood(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Growth rings about a wandering pith, fibres along the axis, faint rays, bark."""
    x, y, z = points.T
    bend = np.stack([0.4 * z + 3.1, 0 * z, 0 * z + seed], 1)
    x = x + 0.12 * value_noise(bend, 1.0, seed)
    y = y + 0.12 * value_noise(bend + 9.0, 1.0, seed)
    radius = np.hypot(x, y) + 0.035 * fractal(points * [1.5, 1.5, 0.3], 1.5, seed + 1)
    ring = radius * 11.0
    phase = ring - np.floor(ring)
    late = smoothstep((phase - 0.55) / 0.4) * smoothstep((1.0 - phase) / 0.06)
    tone = value_noise(np.stack([np.floor(ring), 0 * ring, 0 * ring], 1), 1.0, seed + 2)
    rgb = _mix(
        np.broadcast_to(_rgb(0.85, 0.66, 0.43), (len(points), 3)),
        _rgb(0.56, 0.34, 0.17),
        late * (0.75 + 0.25 * tone),
    )
    fibre = fractal(points * [1.0, 1.0, 0.06], 24.0, seed + 3, 2)
    angle = np.arctan2(y, x)
    ray = value_noise(np.stack([angle * 18, radius * 1.2, z * 3], 1), 1.0, seed + 4)
    rgb = rgb * (1 + 0.06 * fibre + 0.05 * (ray > 0.62))[:, None]
    bark = smoothstep((0.07 + 0.02 * value_noise(points, 7.0, seed + 5) - depth) / 0.02)
    return _mix(rgb, _rgb(0.28, 0.20, 0.14), bark), np.zeros(len(points), np.int32)


def marble(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """White stone with clouds and two systems of grey veins; no layers."""
    warp = np.stack([fractal(points, 1.3, seed + i, 3) for i in range(3)], 1)
    bent = points + 0.35 * warp
    cloud = fractal(bent, 1.6, seed + 4)
    rgb = _mix(
        np.broadcast_to(_rgb(0.93, 0.92, 0.90), (len(points), 3)),
        _rgb(0.76, 0.77, 0.79),
        0.5 + 0.5 * cloud,
    )
    for k, (frequency, width, strength) in enumerate(((1.1, 0.035, 0.8), (2.6, 0.03, 0.45))):
        sheet = np.abs(fractal(bent, frequency, seed + 11 + k, 3))
        vein = np.exp(-((sheet / width) ** 2))
        fade = 0.5 + 0.5 * value_noise(points, 1.7, seed + 20 + k)
        rgb = _mix(rgb, _rgb(0.36, 0.37, 0.41), strength * vein * fade)
    return rgb, np.zeros(len(points), np.int32)


def concrete(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey paste with angular gravel of two sizes (labelled) and small air voids."""
    rgb = np.broadcast_to(_rgb(0.62, 0.61, 0.58), (len(points), 3))
    rgb = rgb * (1 + 0.08 * fractal(points, 14.0, seed, 2))[:, None].astype(np.float32)
    label = np.zeros(len(points), np.int32)
    for frequency, share in ((3.2, 0.85), (7.0, 0.6)):
        stone = cells(points + 0.03 * value_noise(points, 9.0, seed)[:, None], frequency, seed + 3)
        chosen = (stone.second - stone.first > 0.16) & (stone.random(1) < share) & (label == 0)
        chosen &= stone.first < 0.48
        tone = stone.random(2)[:, None]
        color = _rgb(0.42, 0.41, 0.40) + tone * _rgb(0.34, 0.29, 0.24)
        color = color * (1 + 0.06 * value_noise(points, 18.0, seed + 5))[:, None]
        rgb = np.where(chosen[:, None], color, rgb)
        _, number = np.unique(stone.key[chosen], return_inverse=True)
        label[chosen] = label.max() + 1 + number.reshape(-1)
    return rgb, label


def bone(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Dense ivory cortex over spongy bone with reddish marrow in the pores."""
    rgb = np.broadcast_to(_rgb(0.92, 0.87, 0.75), (len(points), 3))
    rgb = rgb * (1 + 0.03 * fractal(points, 8.0, seed, 2))[:, None].astype(np.float32)
    pore = cells(points, 9.0, seed + 1)
    wall = pore.second - pore.first
    spongy = smoothstep((depth - 0.22) / 0.12)
    rgb = _mix(rgb, _rgb(0.66, 0.42, 0.32), spongy * smoothstep((wall - 0.16) / 0.10))
    return rgb, np.zeros(len(points), np.int32)


def jelly(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Clear red gel: darker with depth, a few pale bubbles."""
    rgb = _layers(depth, [(0.0, _rgb(0.88, 0.16, 0.22)), (1.0, _rgb(0.62, 0.03, 0.10))])
    rgb = rgb * (1 + 0.04 * fractal(points, 2.5, seed, 2))[:, None]
    bubble = cells(points, 5.0, seed + 1)
    radius = 0.10 + 0.12 * bubble.random(1)
    there = (bubble.random(2) < 0.3) & (bubble.first < radius)
    rgb = np.where(there[:, None], _mix(rgb, _rgb(0.98, 0.62, 0.62), np.full(len(rgb), 0.6)), rgb)
    return rgb, np.zeros(len(points), np.int32)


def stuffing(points: np.ndarray, depth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """White polyester wadding under a thin cloth."""
    bent = points + 0.2 * np.stack([fractal(points, 3.0, seed + i, 2) for i in range(3)], 1)
    strand = fractal(bent * [1.0, 0.35, 1.0], 11.0, seed + 5, 3)
    rgb = np.broadcast_to(_rgb(0.90, 0.89, 0.86), (len(points), 3))
    rgb = rgb * (1 + 0.09 * strand + 0.05 * fractal(points, 2.0, seed + 6, 2))[:, None]
    return rgb.astype(np.float32), np.zeros(len(points), np.int32)


PRESETS: dict[str, Preset] = {
    "apple": apple,
    "bone": bone,
    "bread": bread,
    "concrete": concrete,
    "jelly": jelly,
    "marble": marble,
    "orange": orange,
    "stuffing": stuffing,
    "watermelon": watermelon,
    "wood": wood,
}


def preset_names() -> list[str]:
    """Names of the presets, sorted."""
    return sorted(PRESETS)


def procedural_texture(domain: InteriorDomain, preset: str, seed: int) -> InteriorTexture:
    """Evaluate a preset in every inside voxel.

    Raises:
        InputError: Unknown preset.
    """
    if preset not in PRESETS:
        raise InputError(
            f"texture: preset must be one of {', '.join(preset_names())}, got {preset!r}",
            mend="choose one of these or give an exemplar photograph",
        )
    index = np.argwhere(domain.inside)
    scale = max(domain.max_depth, 1.0)
    middle = 0.5 * (index.min(0) + index.max(0)) + 0.5
    points = (index + 0.5 - middle) / scale
    points = points @ axis_frame(domain.axis).T
    depth = domain.depth[domain.inside] / scale
    color, label = PRESETS[preset](points, depth, seed)
    rgb = np.zeros((*domain.inside.shape, 3), np.float32)
    rgb[domain.inside] = color.clip(0.0, 1.0)
    labels = np.zeros(domain.inside.shape, np.int32)
    labels[domain.inside] = label
    return InteriorTexture(rgb, labels, {"preset": preset, "inclusions": int(label.max(initial=0))})
