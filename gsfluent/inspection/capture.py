"""``gsfluent inspect``: what is in a capture or a splat, before anything is computed from it."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Capture, Frame
from gsfluent.errors import InputError
from gsfluent.inspection.picture import Picture, draw
from gsfluent.io import kind_of, load_capture, load_splats, save_image
from gsfluent.pipeline.capture.hull import hull_points, inside_masks, masked_views
from gsfluent.pipeline.capture.orient import (
    DEFAULT_SIZE,
    Orientation,
    look_at_point,
    near_points,
    orient,
    upright_rotation,
)
from gsfluent.spatial.shape import cluster, lone_points, robust_box, thin_parts

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_OPAQUE = 0.1
_PHOTO_SIZE = 640


def inspect(
    input: str | Path,
    out: str | Path | None = None,
    *,
    size: float | None = None,
    device: torch.device | str = "cpu",
) -> dict[str, Any]:
    """Look at a capture folder or a splat file.

    Args:
        input: Folder with a COLMAP model or ``transforms.json``, or a 3DGS ``.ply``.
        out: PNG to write, or None for no picture.
        size: Largest extent of the object [m]; assumed when None.
        device: Not needed by the look itself; accepted so that every verb takes it.

    Returns:
        The report (JSON values): ``kind``, counts, ``up``, ``floor``, ``box`` in metres, ``scale``,
        ``pieces``, ``floaters``, ``thin``, ``warnings``, and a ``shot`` to begin with.

    Raises:
        InputError: The input cannot be read, or ``size`` is not positive.
    """
    if size is not None and not size > 0:
        raise InputError(
            f"size must be above 0 metres, got {size}", "give the largest extent in metres"
        )
    path = Path(input)
    if path.is_file() and kind_of(path) == "splats":
        return _inspect_splats(path, out, size)
    return _inspect_capture(path, out, size)


@dataclasses.dataclass(frozen=True)
class _Found:
    """Points of the object in world coordinates, with what stands off it."""

    points: Array
    colors: Array
    radii: Array
    floaters: NDArray[np.bool_]
    pieces: list[float]  # shares of the points; empty when the cloud is too sparse to tell


def _shares(index: NDArray[np.int64], pieces: int) -> list[float]:
    counts = np.bincount(index)[:pieces]
    return [round(float(count / len(index)), 4) for count in counts]


def _inspect_splats(path: Path, out: str | Path | None, size: float | None) -> dict[str, Any]:
    gaussians = load_splats(path)
    opaque = gaussians.select(gaussians.opacities > _OPAQUE)
    if opaque.count < 10:
        opaque = gaussians
    points = opaque.means.double().numpy()
    groups = cluster(points)
    radii = opaque.scales.median(dim=1).values.double().numpy()
    stance = orient(opaque)
    facts: dict[str, Any] = {
        "input": str(path),
        "kind": "splats",
        "gaussians": gaussians.count,
        "opaque": opaque.count,
        "sh_degree": gaussians.sh_degree,
        "anisotropy": float((gaussians.scales.amax(dim=1) / gaussians.scales.amin(dim=1)).median()),
    }
    reach = opaque.scales.amax(dim=1).double().numpy()
    thin = thin_parts(points[~groups.floaters], reach[~groups.floaters])
    colors = opaque.colors().double().numpy()
    found = _Found(points, colors, radii, groups.floaters, _shares(groups.index, groups.pieces))
    return _finish(facts, found, stance, thin, None, size, out)


def _inspect_capture(path: Path, out: str | Path | None, size: float | None) -> dict[str, Any]:
    capture = load_capture(path)
    first = capture.cameras[0]
    facts: dict[str, Any] = {
        "input": str(path),
        "kind": "capture",
        "images": len(capture),
        "image_size": [first.width, first.height],
        "distorted": any(any(camera.distortion) for camera in capture.cameras),
        "masks": sum(camera.mask_path is not None for camera in capture.cameras),
        "points": len(capture.points),
    }
    if len(capture.points) < 20:
        points, colors = hull_points(capture, look_at_point(capture.cameras))
        if len(points) < 20:
            raise InputError(
                f"{path}: neither sparse points nor masks say where the object is",
                "reconstruct first, then inspect the .ply; or add points3D, ply_file_path or masks",
            )
        facts["points_from"] = "masks"
        stance = orient(
            None,
            capture.replace(
                points=torch.from_numpy(points), point_colors=torch.zeros(len(points), 3)
            ),
        )
    else:
        facts["points_from"] = "sparse model"
        stance = orient(None, capture)
        points, colors = _object_of(capture, stance)
    # Sparse points are dots; hull voxels are as large as their spacing, so that the surface closes.
    radius = float(np.ptp(points, axis=0).max()) / 60 if facts["points_from"] == "masks" else 0.0
    found = _Found(points, colors, np.full(len(points), radius), lone_points(points), [])
    return _finish(facts, found, stance, None, capture, size, out)


def _object_of(capture: Capture, stance: Orientation) -> tuple[Array, Array]:
    """Sparse points of the object: near the cameras' focus, above the floor, seen by most."""
    points = capture.points.double().numpy()
    colors = capture.point_colors.double().numpy()
    near = near_points(capture, stance.focus)
    reach = float(np.linalg.norm(near - stance.focus, axis=1).max())
    keep = np.linalg.norm(points - stance.focus, axis=1) <= reach
    if stance.floor_from == "support plane":
        keep &= points @ stance.up > stance.floor + 0.03 * reach
    seen = np.zeros(len(points))
    for camera in capture.cameras:
        pixels, depth = camera.project(capture.points)
        inside = (
            (pixels >= 0).all(dim=1)
            & (pixels[:, 0] < camera.width)
            & (pixels[:, 1] < camera.height)
        )
        seen += (inside & (depth > 0)).numpy()
    keep &= seen >= 0.6 * len(capture)
    if capture.has_masks:
        keep &= inside_masks(masked_views(capture), capture.points) >= 0.6
    index = np.flatnonzero(keep)
    index = index[~lone_points(points[index])]
    if len(index) < 20:
        return near, np.full((len(near), 3), 0.5)
    main = index[cluster(points[index], cells=16).index == 0]
    index = np.flatnonzero(keep)
    # The sparse cloud of one object falls apart; what is close to the main cluster belongs to it.
    low, high = robust_box(points[main])
    half = (high - low) / 2
    close = (np.abs(points[index] - (low + high) / 2) <= 1.5 * half).all(axis=1)
    chosen = index[close]
    return points[chosen], colors[chosen]


def _finish(
    facts: dict[str, Any],
    found: _Found,
    stance: Orientation,
    thin: dict[str, Any] | None,
    capture: Capture | None,
    size: float | None,
    out: str | Path | None,
) -> dict[str, Any]:
    """Turn everything to scene metres, complete the report, draw."""
    rotation = upright_rotation(stance.up, None if capture is None else capture.cameras)
    solid = found.points[~found.floaters] @ rotation.T
    low, high = robust_box(solid)
    extent = float((high - low).max())
    if not extent > 0:
        raise InputError(f"{facts['input']}: everything lies in one point", "check the file")
    scale = (size or DEFAULT_SIZE) / extent
    if stance.floor_from == "support plane":
        low[2] = stance.floor  # what stands on the plane reaches down to it, seen or not
    ground = low[2]
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, ground])
    frame = Frame(torch.from_numpy(rotation), torch.from_numpy(-scale * base), scale)
    low, high = (
        frame.apply(torch.from_numpy(corner)).numpy()
        for corner in (low @ rotation, high @ rotation)
    )
    report = dict(facts)
    report["up"] = {"axis": (stance.up.round(4) + 0.0).tolist(), "from": stance.up_from}
    report["floor"] = {"height": 0.0, "world": float(ground), "from": stance.floor_from}
    report["scale"] = {
        "metres_per_unit": scale,
        "from": f"largest extent {size:g} m"
        if size
        else f"assumed largest extent {DEFAULT_SIZE:g} m",
    }
    report["box"] = {"low": low.tolist(), "high": high.tolist(), "size": (high - low).tolist()}
    report["world_extent"] = extent
    if found.pieces:
        report["pieces"] = found.pieces
    loose = int(found.floaters.sum())
    report["floaters"] = {"count": loose, "share": loose / len(found.points)}
    if thin is not None:
        report["thin"] = _thin_in_metres(thin, frame)
    report["warnings"] = _warnings(report, capture, size)
    report["shot"] = {
        "capture" if capture is not None else "splats": facts["input"],
        "size": size or DEFAULT_SIZE,
        "up": (stance.up.round(4) + 0.0).tolist(),
    }
    if out is not None:
        placed = frame.apply(torch.from_numpy(found.points)).numpy()
        photograph = None if capture is None else (_telling_view(capture), frame)
        cameras = np.zeros((0, 3)) if capture is None else frame.apply(capture.centers()).numpy()
        picture = Picture(
            placed,
            found.colors,
            found.radii * scale,
            found.floaters,
            low,
            high,
            0.0,
            cameras,
            _lines(report),
            photograph,
        )
        save_image(draw(picture), out)
        report["picture"] = str(out)
    return report


def _telling_view(capture: Capture) -> Any:
    """Read the photograph taken from the middle height, so that box and floor can be told apart."""
    heights = capture.centers() @ torch.stack([camera.up() for camera in capture.cameras]).mean(
        dim=0
    )
    index = int(heights.argsort()[len(capture) // 2])
    return capture.view(index, _PHOTO_SIZE)


def _thin_in_metres(thin: dict[str, Any], frame: Frame) -> dict[str, Any]:
    parts = []
    for part in thin["parts"]:
        center = frame.apply(torch.tensor(part["center"], dtype=torch.float64))
        parts.append({"center": center.tolist(), "length": max(part["extent"]) * frame.scale})
    return {**thin, "limit": thin["limit"] * frame.scale, "parts": parts}


def _warnings(report: dict[str, Any], capture: Capture | None, size: float | None) -> list[str]:
    """Say what a user should look at before going on."""
    found = []
    if size is None:
        found.append(f"the size is a guess ({DEFAULT_SIZE:g} m); set size or scale in the shot")
    if report["up"]["from"] == "convention":
        found.append(
            "a splat does not tell which way is up; -y is assumed: set up if the picture is wrong"
        )
    if report["floaters"]["share"] > 0.02:
        found.append(
            f"{100 * report['floaters']['share']:.0f} % of the points float off the object"
        )
    if len(report.get("pieces", [])) > 1:
        found.append(f"{len(report['pieces'])} separate pieces")
    thin = report.get("thin")
    if thin is not None and thin["share"] > 0.5:
        found.append("thin nearly everywhere: an open shell, or a sheet")
    elif thin is not None and thin["share"] > 0.05:
        found.append(
            f"{100 * thin['share']:.0f} % of it is thinner than {1000 * thin['limit']:.0f} mm"
        )
    if capture is not None and report["masks"] == 0 and report["points_from"] != "masks":
        found.append("no masks: the background is removed by geometry")
    return found


def _lines(report: dict[str, Any]) -> list[str]:
    """Text for the picture."""
    axis = ", ".join(f"{part:+.2f}" for part in report["up"]["axis"])
    wide, deep, tall = (100 * part for part in report["box"]["size"])
    what = (
        f"{report['images']} photographs, points from the {report['points_from']}"
        if report["kind"] == "capture"
        else f"{report['gaussians']} Gaussians, SH degree {report['sh_degree']}"
    )
    return [
        f"{Path(report['input']).name}: {what}",
        f"box {wide:.1f} x {deep:.1f} x {tall:.1f} cm; "
        f"1 unit = {report['scale']['metres_per_unit']:.4g} m "
        f"({report['scale']['from']})",
        f"up [{axis}] from {report['up']['from']}; floor from {report['floor']['from']}; "
        f"{report['floaters']['count']} floaters (magenta)",
        *(f"! {warning}" for warning in report["warnings"]),
    ]
