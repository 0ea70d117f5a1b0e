"""Photographs of the corner of a papered room, from known places: enough for COLMAP to work on."""

from __future__ import annotations

import cv2
import numpy as np
from papered import blotted, rays_to

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
VIEWS = 9


def eyes(count: int = VIEWS) -> np.ndarray:
    """Where the photographs are taken from: an arc in the corner of a room."""
    turn = np.linspace(0.25, 1.3, count)
    height = 1.6 + 0.4 * np.sin(np.arange(count))
    return np.stack([3 * np.cos(turn), 3 * np.sin(turn), height], axis=1)


def photograph(eye: np.ndarray, walls: list[np.ndarray]) -> np.ndarray:
    """The corner of three papered walls, seen from inside, looking at (0.3, 0.3, 0.3)."""
    rays = rays_to(eye, np.full(3, 0.3), (WIDTH, HEIGHT), FOCAL)
    with np.errstate(divide="ignore"):
        reach = np.where(rays < 0, -eye / rays, np.inf)  # to the three planes
    wall = reach.argmin(axis=-1)
    hit = eye + reach.min(axis=-1)[..., None] * rays
    picture = np.zeros((HEIGHT, WIDTH), np.float32)
    for axis in range(3):
        u, v = (hit[..., k].astype(np.float32) * 60 for k in range(3) if k != axis)
        seen = cv2.remap(walls[axis], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        picture = np.where(wall == axis, seen, picture)
    return np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def walls() -> list[np.ndarray]:
    """Papers with blots of several sizes."""
    random = np.random.default_rng(0)
    return [128 + 40 * blotted(random) for _ in range(3)]
