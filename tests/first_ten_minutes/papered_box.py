"""Photographs of a papered box on a papered floor, taken all around: COLMAP finds them."""

from __future__ import annotations

import cv2
import numpy as np
from papered import blotted, rays_to

WIDTH, HEIGHT, FOCAL = 320, 240, 380.0
HALF = np.array([0.30, 0.24, 0.20])
"""Half sides of the box; it stands on the floor z = 0."""


def eyes(count: int) -> np.ndarray:
    """Where the photographs are taken from: a ring with two heights."""
    turn = 2 * np.pi * np.arange(count) / count
    height = 0.9 + 0.25 * (np.arange(count) % 2)
    return np.stack([1.5 * np.cos(turn), 1.5 * np.sin(turn), height], axis=1)


def photograph(eye: np.ndarray, papers: list[np.ndarray]) -> np.ndarray:
    """The box and the floor under it, looking at the middle of the box."""
    centre = np.array([0.0, 0.0, HALF[2]])
    rays = rays_to(eye, centre, (WIDTH, HEIGHT), FOCAL)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(centre + side * HALF - eye) / rays for side in (-1, 1)])
        near = ends.min(axis=0)
        enter, leave = near.max(axis=-1), ends.max(axis=0).min(axis=-1)
        floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], 1e3)
    box = (enter < leave) & (enter > 0)
    hit = eye + np.where(box, enter, floor)[..., None] * rays
    axis = np.where(box, near.argmax(axis=-1), 3)
    picture = np.full((HEIGHT, WIDTH, 3), 225.0, np.float32)
    for which in range(4):
        plane = [k for k in range(3) if k != min(which, 2)]
        u, v = (hit[..., k].astype(np.float32) * 260 + 1000 for k in plane)
        seen = cv2.remap(papers[which], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        here = (axis == which) & (np.abs(hit) < 2.0).all(axis=-1)
        picture = np.where(here[..., None], seen, picture)
    return picture.clip(0, 255).astype(np.uint8)


def papers() -> list[np.ndarray]:
    """Papers with blots of several sizes: three for the box, reddish; one for the floor, grey."""
    random = np.random.default_rng(0)
    made = []
    for which in range(4):
        paper = blotted(random)
        tint = np.array([1, 1, 1] if which == 3 else [1.0, 0.45, 0.3], np.float32)
        made.append((128 + 40 * paper)[..., None] * tint)
    return made
