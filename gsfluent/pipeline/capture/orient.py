"""Which way is up, where the floor is, how large a unit is: from the world to scene metres."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent import geometry
from gsfluent.config import Shot
from gsfluent.data import Camera, Capture, Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.capture.front import photographers_side, splats_side
from gsfluent.spatial.mesh_file import in_metres, up_axes
from gsfluent.spatial.shape import cluster, robust_box
from gsfluent.spatial.standing import upright

Array = NDArray[np.float64]


DEFAULT_SIZE = 0.2
"""Largest extent [m] assumed for an object of unknown size: what fits in two hands."""

_SPLAT_UP = (0.0, -1.0, 0.0)
"""Up of a splat without cameras: trainers keep COLMAP's axes, where y points down."""

_OTHER_UPS = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
"""Up of splats that somebody has turned, likeliest first."""

_HELD = np.radians(45.0)
"""Photographers hold their camera upright to within this; their splats lean no farther."""

_PLAUSIBLE = (0.01, 5.0)
"""Extents [m] of objects that a file in metres is believed about."""

_LEVEL = 0.05
"""Mean squared sine of the cameras' roll below which they count as held level."""

_TILT = np.cos(np.radians(30.0))
"""A support plane may lean this far from what the cameras say is up."""

_UNDER = 0.4
"""Share of the points of an object from which a plane above them is not what it stands on."""

_OPAQUE = 0.1
"""Splats fainter than this do not count for an object's extent."""


@dataclasses.dataclass(frozen=True)
class Orientation:
    """How an input stands in its own coordinates."""

    up: Array  # unit up axis [3], world
    # what it was taken from: ``given``, ``support plane``, ``cameras``, ``file format``,
    # ``convention`` or, against it, ``shape``.
    up_from: str
    floor: float  # coordinate of the floor along ``up``, world units
    floor_from: str  # ``given``, ``support plane`` or ``lowest point``
    focus: Array  # point that the cameras look at [3], or the centre of the splats


def orient(
    gaussians: Gaussians | None,
    capture: Capture | None = None,
    up: Any = "auto",
    mesh: Path | None = None,
) -> Orientation:
    """Find the up axis and the floor.

    Up: as given; else the normal of the plane that carries the object, if the sparse points show
    one near what the cameras suggest; else the axis that level cameras turn about. Without cameras:
    what the format of a mesh lays down, or -y for a splat, unless the thing falls over on it
    (:func:`gsfluent.spatial.standing.upright`). Floor: that plane, else the lowest point.

    Args:
        gaussians: The object's splats, or None when there is only a capture.
        capture: The photographs it comes from, or None.
        up: ``"auto"`` or three numbers.
        mesh: The mesh file that the splats cover, or None.

    Raises:
        InputError: Neither splats nor a capture with points are given.
    """
    points = _object_points(gaussians, capture)
    focus = points.mean(axis=0) if capture is None else look_at_point(capture.cameras)
    plane = None
    if not isinstance(up, str):
        axis, source = np.asarray(up, dtype=np.float64), "given"
        axis = axis / np.linalg.norm(axis)
    elif capture is None:
        axis, source = _standing_up(points, mesh)
    else:
        axis, source = camera_up(capture.cameras), "cameras"
    if capture is not None and len(capture.points) >= 100:
        plane = support_plane(capture, axis, focus)
    if plane is not None:
        if source != "given":
            axis, source = plane[0], "support plane"
        elif plane[0] @ axis < np.cos(np.radians(5.0)):
            plane = None  # a slanted surface is no floor for the up axis the user gave
    if plane is not None:
        return Orientation(axis, source, float(plane[1]), "support plane", focus)
    return Orientation(
        axis, source, float(np.quantile(points @ axis, 0.002)), "lowest point", focus
    )


def _standing_up(points: Array, mesh: Path | None) -> tuple[Array, str]:
    """The axis on which a thing without cameras stands, and what says so."""
    if mesh is None:
        axes, said = [np.array(axis) for axis in (_SPLAT_UP, *_OTHER_UPS)], False
    else:
        known = up_axes(mesh)
        axes, said = [axis for axis, _ in known], known[0][1]
    if said:
        return axes[0], "file format"
    if mesh is not None:
        axis, turned = upright(points, axes)
    else:
        # photographs are held upright, more or less
        axis, turned = upright(points[~cluster(points).floaters], axes, most=_HELD)
    return axis, "shape" if turned else "convention"


def make_frame(
    gaussians: Gaussians, capture: Capture | None = None, shot: Shot | None = None
) -> Frame:
    """Return the transform from world coordinates to scene metres.

    The scene has +z up. The object's centre stands on the z axis; its lowest point lies at z = 0,
    unless the shot gives a floor height, or asks for the support plane, which then becomes z = 0.

    Args:
        gaussians: The object's splats (background removed), world coordinates.
        capture: The photographs, used for the up axis.
        shot: Settings ``up``, ``front``, ``floor``, ``origin``, ``scale`` and ``size``, and the
            mesh whose unit may be known; automatic without.

    Raises:
        InputError: No splats, or all in one point; or no support plane where one is asked for.
    """
    gaussians.validated("make_frame")
    mesh, up = (None, "auto") if shot is None else (shot.mesh, shot.up)
    stance = orient(gaussians, capture, up, mesh)
    cameras = None if capture is None else capture.cameras
    front: Any = None if shot is None or isinstance(shot.front, str) else shot.front
    if shot is not None and shot.front == "guess":
        if cameras:
            front, _ = photographers_side(cameras, stance.up)
        else:
            usual = -upright_rotation(stance.up)[1]
            front, _ = splats_side(gaussians.to("cpu"), stance.up, usual)
    rotation = upright_rotation(stance.up, cameras, front)
    points = _object_points(gaussians, None)
    points = points[~cluster(points).floaters]
    if stance.floor_from == "support plane":
        # nobody saw what reconstruction leaves below the plane that the object stands on
        points = points[~below_support(points, stance.up, stance.floor)]
    points = points @ rotation.T
    low, high = robust_box(points)
    extent = float((high - low).max())
    if not extent > 0:
        raise InputError(
            "make_frame: all splats lie in one point", "check the splat file or the selection"
        )
    scale = DEFAULT_SIZE / extent
    if shot is not None and shot.scale is not None:
        scale = shot.scale
    elif shot is not None and shot.size is not None:
        scale = shot.size / extent
    elif mesh is not None and in_metres(mesh) and _PLAUSIBLE[0] <= extent <= _PLAUSIBLE[1]:
        scale = 1.0
    ground = low[2]
    if shot is not None and not isinstance(shot.floor, str):
        ground = shot.floor / scale
    elif shot is not None and shot.floor == "plane":
        if stance.floor_from != "support plane":
            raise InputError(
                "floor: plane: the capture shows no plane that the object stands on",
                "use floor: auto, or give its height",
            )
        ground = stance.floor
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, ground])
    if shot is not None and shot.origin == "input":
        base = np.array([0.0, 0.0, 0.0 if shot.floor == "none" else ground])
    return Frame(torch.from_numpy(rotation), torch.from_numpy(-scale * base), scale)


def below_support(points: Array, normal: Array, offset: float) -> NDArray[np.bool_]:
    """Which points [N, 3] lie below a support plane, bool [N]; none where it cannot be theirs.

    A plane is believed that leaves most of the points above it. What lies within a hundredth of
    their height of it stands on it.
    """
    height = points @ normal - offset
    reach = float(np.quantile(height, 0.99)) if len(height) else 0.0
    below = height < -0.01 * max(reach, 0.0)
    if reach <= 0.0 or below.mean() >= _UNDER:
        return np.zeros(len(points), dtype=np.bool_)
    return np.asarray(below)


def upright_rotation(up: Array, cameras: list[Camera] | None = None, front: Any = None) -> Array:
    """Rotation [3, 3] that carries ``up`` onto +z and the front onto -y, where films begin.

    The front: the direction ``front`` [3] (from the object towards who looks at it); else where the
    first photograph was taken from; else what stands there by the custom of the axes, which is +z
    of a y-up and -z of a -y-up world, and -y of a z-up one.

    Raises:
        InputError: ``front`` points along ``up``.
    """
    rotation = geometry.rotation_between(
        torch.from_numpy(up), torch.tensor([0.0, 0.0, 1.0])
    ).numpy()
    ahead = None
    if front is not None:
        ahead = -(rotation @ np.asarray(front, dtype=np.float64))
        ahead /= np.linalg.norm(ahead)
        if np.hypot(ahead[0], ahead[1]) < 0.1:
            raise InputError(
                f"front: [{', '.join(f'{part:g}' for part in front)}] points up or down",
                "give a direction across the up axis",
            )
    elif cameras:
        ahead = rotation @ cameras[0].forward().numpy()
    if ahead is not None:
        length = float(np.hypot(ahead[0], ahead[1]))
        if length > 0.1:  # a camera that looks straight down has no front
            x, y = ahead[0] / length, ahead[1] / length
            rotation = np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]]) @ rotation
    return np.asarray(rotation)


def camera_up(cameras: list[Camera]) -> Array:
    """Up axis from cameras: perpendicular to all their horizontal axes, if they were held level.

    With level cameras from several sides that axis is sharp: the eigenvector of sum(x x^T) with the
    smallest eigenvalue. Otherwise the mean of the image-up directions is taken.
    """
    mean = torch.stack([camera.up() for camera in cameras]).to(torch.float64).mean(dim=0).numpy()
    across = torch.stack([camera.viewmat[0, :3] for camera in cameras]).to(torch.float64).numpy()
    values, vectors = np.linalg.eigh(across.T @ across / len(across))
    if values[0] < _LEVEL and values[1] > 2 * _LEVEL:
        axis = vectors[:, 0]
        if abs(axis @ mean) > 0.1:
            return np.asarray(axis * np.sign(axis @ mean))
    length = float(np.linalg.norm(mean))
    if length < 1e-3:
        return np.array(_SPLAT_UP)
    return np.asarray(mean / length)


def look_at_point(cameras: list[Camera]) -> Array:
    """Point nearest to all optical axes, least squares [3]; one unit ahead for parallel cameras."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        axis = camera.forward().to(torch.float64).numpy()
        projector = np.eye(3) - np.outer(axis, axis)
        matrix += projector
        right += projector @ camera.center().to(torch.float64).numpy()
    if np.linalg.cond(matrix) > 1e6:
        return np.asarray((cameras[0].center() + cameras[0].forward()).to(torch.float64).numpy())
    return np.asarray(np.linalg.solve(matrix, right))


def support_plane(capture: Capture, up: Array, focus: Array) -> tuple[Array, float] | None:
    """Find the plane the object stands on: (unit normal [3], offset along it), or None.

    RANSAC over triples of points near the object. A plane counts when its normal is within 30
    degrees of ``up``, at least 15 % of the points lie on it, hardly any below it, and the cameras
    are above it.
    """
    centers = capture.centers().numpy()
    reach = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    points = near_points(capture, focus)
    if len(points) < 100:
        return None
    rng = np.random.default_rng(0)
    sample = points if len(points) <= 4000 else points[rng.choice(len(points), 4000, replace=False)]
    band = 0.01 * reach
    normals, offsets = _candidate_planes(sample, up, rng)
    best: tuple[float, Array, float] | None = None
    for normal, offset in zip(normals, offsets, strict=True):
        height = sample @ normal - offset
        on, below = np.abs(height) < band, height < -3 * band
        score = float(on.mean() - 3.0 * below.mean())
        if (best is None or score > best[0]) and np.mean(centers @ normal > offset) > 0.9:
            best = (score, normal, float(offset))
    if best is None:
        return None
    _, normal, offset = best
    for _ in range(5):  # least squares on the inliers
        near = points[np.abs(points @ normal - offset) < band]
        if len(near) < 3:
            return None
        middle = near.mean(axis=0)
        axis = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = axis * np.sign(axis @ up)
        offset = float(normal @ middle)
    height = points @ normal - offset
    on, below = np.mean(np.abs(height) < band), np.mean(height < -3 * band)
    if on < 0.15 or below > 0.1 or normal @ up < _TILT:
        return None
    return np.asarray(normal), offset


def near_points(capture: Capture, focus: Array) -> Array:
    """Sparse points nearer to ``focus`` than half the cameras' distance [M, 3]."""
    points = np.asarray(capture.points.to(torch.float64).numpy())
    distance = np.linalg.norm(points - focus, axis=1)
    reach = float(np.median(np.linalg.norm(capture.centers().numpy() - focus, axis=1)))
    near = points[distance < 0.5 * reach]
    return near if len(near) >= 100 else points[distance <= max(reach, float(np.median(distance)))]


def _candidate_planes(points: Array, up: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Planes through random triples whose normal is near ``up``: normals [M, 3], offsets [M]."""
    triples = points[rng.integers(0, len(points), size=(4000, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    keep = length > 1e-12
    normals, triples = normals[keep] / length[keep, None], triples[keep]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    near = normals @ up > _TILT
    normals, triples = normals[near][:1000], triples[near][:1000]
    return normals, (normals * triples[:, 0]).sum(axis=1)


def _object_points(gaussians: Gaussians | None, capture: Capture | None) -> Array:
    """Centres of the opaque splats, or the sparse points [N, 3]."""
    if gaussians is not None:
        opaque: Tensor = gaussians.means[gaussians.opacities > _OPAQUE]
        if len(opaque) < 10:
            opaque = gaussians.means
        return np.asarray(opaque.detach().to("cpu", torch.float64).numpy())
    if capture is None or len(capture.points) == 0:
        raise InputError(
            "orient: neither splats nor sparse points are there",
            "give splats, or a capture with points3D",
        )
    return near_points(capture, look_at_point(capture.cameras))
