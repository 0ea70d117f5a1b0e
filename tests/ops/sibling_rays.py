"""Nearest-only compositing of siblings along one ray, float64, written from the rule.

The rule (Fracture-GS, occlusion-aware sampling; equations.md section 14): along a ray, splats are
taken front to back; of the splats made from the same parent only the first that contributes counts.
Nothing is shared with the kernels but the conventions of splatting: the screen-space Gaussian with
0.3 px^2 added, its support, the cap and the skip of small opacities, and the end of a ray.
"""

from __future__ import annotations

import math

import numpy as np


def project(
    means: np.ndarray, covariances: np.ndarray, viewmat: np.ndarray, K: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel centres [N, 2], inverse screen covariances [N, 2, 2] and depths [N]."""
    turn, shift = viewmat[:3, :3], viewmat[:3, 3]
    centres, inverses, depths = [], [], []
    for mean, covariance in zip(means, covariances, strict=True):
        x, y, z = turn @ mean + shift
        slope = np.array(
            [[K[0, 0] / z, 0.0, -K[0, 0] * x / z**2], [0.0, K[1, 1] / z, -K[1, 1] * y / z**2]]
        )
        flat = slope @ turn @ covariance @ turn.T @ slope.T + 0.3 * np.eye(2)
        centres.append((K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]))
        inverses.append(np.linalg.inv(flat))
        depths.append(z)
    return np.array(centres), np.array(inverses), np.array(depths)


def ray(
    pixel: tuple[int, int],
    centres: np.ndarray,
    inverses: np.ndarray,
    depths: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    groups: np.ndarray,
    memory: int | None = None,
) -> tuple[np.ndarray, float, int]:
    """Colour, opacity and number of groups met along the ray of a pixel (column, row).

    Args:
        pixel: Column and row.
        centres: Pixel centres [N, 2].
        inverses: Inverse screen covariances [N, 2, 2].
        depths: Camera z [N].
        opacities: Peak opacities [N].
        colors: Colours [N, C].
        groups: Parent of each splat, -1 for none, [N].
        memory: How many groups are remembered, the latest; None remembers all, which is the rule.
    """
    at = np.array(pixel) + 0.5
    color, left = np.zeros(colors.shape[1]), 1.0
    met: list[int] = []
    # the kernels sort by depth in single precision
    for k in np.argsort(depths.astype(np.float32), kind="stable"):
        away = at - centres[k]
        power = 0.5 * float(away @ inverses[k] @ away)
        if opacities[k] < 1 / 255 or power > min(math.log(255 * opacities[k]), 0.5 * 3.33**2):
            continue
        known = met if memory is None else met[-memory:]
        if groups[k] >= 0 and groups[k] in known:
            continue
        alpha = min(float(np.float32(0.99)), opacities[k] * math.exp(-power))
        if left * (1 - alpha) <= 1e-4:
            break
        color += left * alpha * colors[k]
        left *= 1 - alpha
        if groups[k] >= 0:
            met.append(int(groups[k]))
    return color, 1 - left, len(set(met))
