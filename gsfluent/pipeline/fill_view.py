"""Cut views: a solid sliced open and looked at, for ``interior.png`` and for eyes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsfluent.errors import InputError

if TYPE_CHECKING:
    from gsfluent.data import Gaussians, Solid

__all__ = ["cut_view", "surface_colors"]


def surface_colors(gaussians: Gaussians, points: np.ndarray, width: float) -> np.ndarray:
    """Colours of the surface around given points.

    The eight nearest surface splats count with their opacity and a Gaussian of the distance, so
    that a single odd splat does not paint a spot.

    Args:
        gaussians: Splats; with labels, only the SURFACE ones are used.
        points: [M, 3] world units, near the surface.
        width: Standard deviation of the averaging, world units (a voxel is usual).

    Returns:
        Colours float32 [M, 3] in 0..1.

    Raises:
        InputError: There are no surface splats.
    """
    from scipy.spatial import cKDTree

    from gsfluent.data import SURFACE

    if gaussians.labels is not None:
        gaussians = gaussians.select(gaussians.labels == SURFACE)
    if gaussians.count == 0:
        raise InputError("no surface Gaussians: labels hold none", mend="run fill on a splat first")
    means = gaussians.means.detach().double().cpu().numpy()
    colors = gaussians.colors().detach().float().cpu().numpy().clip(0.0, 1.0)
    alpha = gaussians.opacities.detach().float().cpu().numpy()
    count = min(8, means.shape[0])
    distance, nearest = cKDTree(means).query(points, k=count)
    distance, nearest = distance.reshape(-1, count), nearest.reshape(-1, count)
    # relative to the nearest one, so that points farther away still get a defined colour
    spread = (distance - distance[:, :1]) / width
    weight = (alpha[nearest] + 1e-4) * np.exp(-0.5 * spread**2)
    weight /= weight.sum(1, keepdims=True)
    result: np.ndarray = np.einsum("nk,nkc->nc", weight, colors[nearest]).astype(np.float32)
    return result


def cut_view(
    solid: Solid,
    axis: int | str = 0,
    offset: float | None = None,
    size: int = 512,
    *,
    background: float = 1.0,
) -> np.ndarray:
    """Look along ``axis`` at the solid with everything before the cutting plane taken away.

    The cut face shows the interior colour (grey before texturing); what lies behind the plane shows
    its surface colour, shaded a little by its slope so that the eye reads the shape.

    Args:
        solid: The solid; ``color`` may be None.
        axis: 0, 1, 2 or "x", "y", "z": the axis the cut is perpendicular to.
        offset: Position of the plane along the axis, world units; None cuts through the middle of
            the matter.
        size: Longest side of the image [pixels].
        background: Grey value of the ground.

    Returns:
        Image float32 [H, W, 3] in 0..1; the first remaining axis runs right, the second up.

    Raises:
        ValueError: Unknown axis or a size below 16.
    """
    names = {"x": 0, "y": 1, "z": 2}
    axis = names.get(axis, -1) if isinstance(axis, str) else axis
    if axis not in (0, 1, 2):
        raise ValueError(f"cut_view: axis must be 0, 1, 2 or x, y, z, got {axis!r}")
    if size < 16:
        raise ValueError(f"cut_view: size must be at least 16 pixels, got {size}")
    occupancy = np.moveaxis(solid.occupancy.cpu().numpy(), axis, 0)
    filled = np.flatnonzero(occupancy.any((1, 2)))
    if filled.size == 0:
        return np.full((size, size, 3), background, np.float32)
    start = float(solid.origin[axis])
    if offset is None:
        plane = int(filled[0] + filled[-1]) // 2
    else:
        plane = int(np.clip((offset - start) / solid.voxel, 0, occupancy.shape[0] - 1))

    behind = occupancy[plane:]
    first = behind.argmax(0)
    seen = np.asarray(behind.any(0))
    face = seen & (first == 0)
    image = np.full((*seen.shape, 3), background, np.float32)
    if solid.color is not None:
        color = np.moveaxis(solid.color.float().cpu().numpy(), axis, 0)
        image[face] = color[plane][face]
    else:
        image[face] = 0.55
    skin = seen & ~face
    if skin.any():
        index = np.zeros((int(skin.sum()), 3), int)
        others = [i for i in range(3) if i != axis]
        rows, columns = np.nonzero(skin)
        index[:, axis] = plane + first[skin]
        index[:, others[0]], index[:, others[1]] = rows, columns
        slope = np.hypot(*np.gradient(np.where(seen, first, first[seen].max()).astype(np.float32)))
        shade = (1.0 / np.sqrt(1.0 + 0.3 * slope**2))[skin]
        origin = np.asarray([float(v) for v in solid.origin])
        points = origin + (index + 0.5) * solid.voxel
        image[skin] = surface_colors(solid.gaussians, points, solid.voxel)
        image[skin] *= (0.25 + 0.55 * shade)[:, None]
    return _enlarge(image, seen, size, background)


def _enlarge(image: np.ndarray, seen: np.ndarray, size: int, background: float) -> np.ndarray:
    """Crop to the matter plus a border and resize, keeping the silhouette smooth."""
    import cv2

    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    border = 2
    top, bottom = max(rows[0] - border, 0), min(rows[-1] + border + 1, seen.shape[0])
    left, right = max(columns[0] - border, 0), min(columns[-1] + border + 1, seen.shape[1])
    crop = image[top:bottom, left:right].transpose(1, 0, 2)[::-1]
    scale = size / max(crop.shape[:2])
    target = (max(1, round(crop.shape[1] * scale)), max(1, round(crop.shape[0] * scale)))
    # cubic within the picture, clipped: linear enlargement would look out of focus
    result = cv2.resize(np.ascontiguousarray(crop), target, interpolation=cv2.INTER_CUBIC)
    clipped: np.ndarray = result.clip(0.0, 1.0).astype(np.float32)
    return clipped
