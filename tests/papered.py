"""What photographs of papered things are drawn by: rays of a camera, and papers with blots."""

from __future__ import annotations

import cv2
import numpy as np


def rays_to(eye: np.ndarray, target: np.ndarray, size: tuple[int, int], focal: float) -> np.ndarray:
    """Rays [H, W, 3] of the pixels of a level camera that looks at a target."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    width, height = size
    y, x = np.mgrid[0.5:height, 0.5:width]
    rays = forward + ((x - width / 2) / focal)[..., None] * right
    return rays + ((y - height / 2) / focal)[..., None] * down


def blotted(random: np.random.Generator) -> np.ndarray:
    """Blots of several sizes, about 0, [480, 480]."""
    paper = np.zeros((480, 480), np.float32)
    for size in (2.0, 4.0, 8.0):
        noise = random.normal(size=(480, 480)).astype(np.float32)
        blots = cv2.GaussianBlur(noise, (0, 0), size)
        paper += blots / blots.std()
    return paper
