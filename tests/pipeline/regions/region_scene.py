"""A ball of known patches, photographed: label maps, cameras and a filled solid."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from gsfluent.data import SURFACE, Camera, Capture, Gaussians, Solid
from gsfluent.io.segmentation.masks import LabelView, Segmentation

RADIUS = 0.1
SIZE = 96
Patch = Callable[[np.ndarray], np.ndarray]


def halves(points: np.ndarray) -> np.ndarray:
    """1 on the side of +x, 2 on the other; a cap of 3 on top."""
    label = np.where(points[:, 0] > 0, 1, 2)
    return np.where(points[:, 2] > 0.75 * RADIUS, 3, label)


def ball_solid(resolution: int = 40) -> Solid:
    """A ball about the origin."""
    voxel = 2.2 * RADIUS / resolution
    axis = (torch.arange(resolution) + 0.5) * voxel - 1.1 * RADIUS
    distance = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1)
    splat = Gaussians.from_colors(
        torch.tensor([[0.0, 0.0, RADIUS]]), torch.full((1,), voxel), torch.ones(1, 3), label=SURFACE
    )
    return Solid(
        splat,
        distance <= RADIUS,
        (RADIUS - distance).clamp(min=0.0),
        torch.full((3,), -1.1 * RADIUS),
        voxel,
    )


def ring(views: int = 14, rise: tuple[float, ...] = (-0.6, 0.1, 0.7)) -> list[Camera]:
    """Cameras around the ball, at several heights."""
    found = []
    for index in range(views):
        turn, height = 2.4 * index, rise[index % len(rise)]
        flat = math.cos(height)
        eye = [flat * math.cos(turn), flat * math.sin(turn), math.sin(height)]
        found.append(
            Camera.look_at(
                [0.45 * e for e in eye], (0, 0, 0), width=SIZE, height=SIZE, fov=34.0,
                name=f"images/{index:03d}.png",
            )
        )  # fmt: skip
    return found


def capture_of(cameras: list[Camera]) -> Capture:
    return Capture(cameras, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), Path("."))


def hits(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels that show the ball, bool [H, W], and the points they show [M, 3]."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    K = camera.K.numpy()
    local = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    d = local.reshape(-1, 3) @ camera.viewmat[:3, :3].numpy()
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    eye = camera.center().numpy()
    b = d @ eye
    root = b**2 - (eye @ eye - RADIUS**2)
    on = root > 0
    points = eye + (-b[on] - np.sqrt(root[on]))[:, None] * d[on]
    return on.reshape(camera.height, camera.width), points


def label_map(camera: Camera, patch: Patch = halves) -> np.ndarray:
    """True labels of a photograph, int32 [H, W]; 0 where it does not show the ball."""
    on, points = hits(camera)
    labels = np.zeros(on.shape, np.int32)
    labels[on] = patch(points)
    return labels


def segmentation(cameras: list[Camera], patch: Patch = halves) -> Segmentation:
    views = tuple(LabelView(camera, label_map(camera, patch)) for camera in cameras)
    names = {
        int(n): f"patch {n}" for n in np.unique(np.concatenate([v.labels for v in views])) if n
    }
    return Segmentation("truth", views, names)


def iou(found: np.ndarray, true: np.ndarray) -> float:
    return float((found & true).sum()) / max(float((found | true).sum()), 1.0)
