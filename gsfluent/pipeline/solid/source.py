"""Where an object's solid comes from: masks, the density of its splats, their depths, or a mesh."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Capture, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.capture.hull import centre_hull, lattice, visual_hull
from gsfluent.pipeline.capture.views import read_views
from gsfluent.pipeline.solid.evidence import Evidence, SolidOptions
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.inside import find_leaks, keep_components
from gsfluent.pipeline.solid.splats import solid_of_splats
from gsfluent.spatial.density import GridBox
from gsfluent.spatial.mesh_distance import grid_winding, oriented_samples, signed_distances
from gsfluent.spatial.mesh_file import load_mesh
from gsfluent.spatial.winding import winding_numbers

if TYPE_CHECKING:
    import trimesh


Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

METHODS = ("auto", "hull", "density", "tsdf", "mesh")
_HULL_SIZE = 400  # pixels of the masks
_HALF = 0.5  # winding number from which a place is inside an open mesh
_BAND = 3.0  # voxels around a mesh with exact distances
_EXACT = 0.01  # error of the volume of a closed mesh from which on smaller voxels are taken
_FINER = 1.03
_FINEST = 2.0  # times the resolution asked for, at most
_SHIFT = np.array([0.31, 0.19, 0.23])  # voxels
_FEW_VIEWS = 8  # cameras below which a hull is a cone


def find_solid(
    gaussians: Gaussians | Evidence | None = None,
    capture: Capture | None = None,
    mesh: trimesh.Trimesh | str | Path | None = None,
    *,
    method: str = "auto",
    resolution: int = 96,
    options: SolidOptions | None = None,
) -> SignedDistance:
    """Signed distances to the surface of an object, from whatever there is.

    Args:
        gaussians: The object's splats (without background), what was gathered of them, or None.
        capture: Its photographs, with masks for ``hull``; cameras for ``tsdf``.
        mesh: A triangle mesh, or a file that trimesh reads.
        method: ``hull`` (visual hull of the masks), ``density`` (opacity density and ray vote, cut
            by the hull where there are masks), ``tsdf`` (fused depths of the splats), ``mesh``, or
            ``auto``: the mesh when there is one, else what the splats enclose less what their
            depths show to be free, else the hull.
        resolution: Voxels along the longest side of the object.
        options: How the solid of splats is decided.

    Returns:
        The field; ``report["why"]`` says why this source was chosen.

    Raises:
        InputError: The method is unknown or needs what was not given, or there is no inside.
    """
    if method not in METHODS:
        raise InputError(f"solid: method {method!r} is not known", f"choose {', '.join(METHODS)}")
    if not 16 <= int(resolution) <= 512:
        raise InputError(
            f"solid: resolution must be in 16..512 voxels, got {resolution}", "96 to 160 is usual"
        )
    chosen, why = _choose(method, gaussians is not None, capture, mesh)
    began = time.perf_counter()
    if chosen == "mesh":
        assert mesh is not None
        read = mesh if not isinstance(mesh, str | Path) else load_mesh(mesh)
        field = _of_mesh(read, resolution, options is None or options.finer)
    elif chosen == "hull":
        assert capture is not None
        field = _of_hull(capture, resolution)
    else:
        assert gaussians is not None
        known = gaussians
        if not isinstance(known, Evidence):
            known = Evidence.of(known, capture, resolution)
        how = "auto" if method == "auto" else chosen
        field, note = solid_of_splats(known, how, options or SolidOptions())
        why += note
    if chosen in ("hull", "density") and field.source in ("hull", "density"):
        field = field.tidied()
    if not bool(field.inside.any()):
        raise InputError(
            f"solid: {chosen} found no inside at {resolution} voxels",
            "try another method or resolution, or check that the input is one closed object",
        )
    seconds = time.perf_counter() - began
    _log.info("solid: %s (%s), volume %.4g", chosen, why, field.volume)
    return field.replace(
        report={"why": why, **field.report, "volume": field.volume, "seconds": seconds}
    )


def _choose(method: str, splats: bool, capture: Capture | None, mesh: Any) -> tuple[str, str]:
    """Which source, and why."""
    masks = capture is not None and capture.shows_masks()
    needs = {"hull": masks, "density": splats, "tsdf": splats}
    if method != "auto":
        if not needs.get(method, mesh is not None):
            what = {"hull": "a capture with masks", "mesh": "a mesh"}.get(method, "splats")
            raise InputError(f"solid: method {method} needs {what}", "give it, or leave auto")
        return method, "asked for"
    if mesh is not None:
        return "mesh", "a mesh is exact"
    if splats:
        return "density", "splats, and masks to cut them by" if masks else "splats, no masks"
    if masks:
        return "hull", "masks and no splats"
    raise InputError("solid: neither splats, nor masks, nor a mesh were given", "give one of them")


def _of_hull(capture: Capture, resolution: int) -> SignedDistance:
    """The conservative hull says where; voxel centres against the masks say exactly how far."""
    views = read_views(capture, _HULL_SIZE, torch.device("cpu"), crop=True)
    rough = visual_hull(views, resolution)
    box = GridBox.of(rough.origin, rough.voxel, rough.occupancy.shape)
    grounds = []
    for view in views:
        assert view.mask is not None  # visual_hull has refused views without
        ground = (view.mask < 0.5).cpu().numpy()
        grounds.append((ground, view.viewmat.double().cpu().numpy(), view.K.double().cpu().numpy()))
    body = rough.occupancy.cpu().numpy() & centre_hull(box, grounds)
    body, dropped = keep_components(body)
    notes = {
        "views": len(views),
        "leaks": 0,
        "cone": len(views) < _FEW_VIEWS,
        "components_dropped": dropped,
    }
    return SignedDistance.of_voxels(body, np.array(box.origin), rough.voxel, "hull", notes)


def _grid_of(low: Array, high: Array, resolution: int) -> tuple[Array, float, Array]:
    """Corner [3], voxel and size [3] of a grid with a rim around a box."""
    voxel = float((high - low).max()) / max(resolution - 1, 1)
    size = np.ceil((high - low) / voxel).astype(int) + 7
    # Off the middle: a symmetric grid counts an even number of layers where there are 23.
    return 0.5 * (low + high) - (0.5 * size + _SHIFT) * voxel, voxel, size


def _exact_resolution(mesh: trimesh.Trimesh, triangles: Array, resolution: int) -> int:
    """The resolution from the one asked for on at which voxels have the volume of a closed mesh.

    A wall of two and a half voxels gets two or three of them; some finer grid has them to one per
    cent. Where parts overlap, mesh and winding numbers both count twice.
    """
    known = abs(float(mesh.volume))
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    best, tried = (math.inf, resolution), float(resolution)
    while tried <= _FINEST * resolution:
        origin, voxel, size = _grid_of(low, high, round(tried))
        grid = [origin[i] + (np.arange(size[i]) + 0.5) * voxel for i in range(3)]
        volume = abs(float(grid_winding(triangles, grid).sum())) * voxel**3
        best = min(best, (abs(volume / known - 1.0), round(tried)))
        if best[0] <= _EXACT:
            break
        tried = max(tried * _FINER, tried + 1.0)
    off, found = best
    if off > _EXACT:
        _log.warning(
            "solid: at %d voxels the volume is %.1f %% off that of the mesh (%.4g); hint: a higher "
            "fill.resolution", found, 100.0 * off, known,
        )  # fmt: skip
    elif found != resolution:
        _log.info("solid: %d voxels instead of %d: the walls are thin", found, resolution)
    return found


def _of_mesh(mesh: trimesh.Trimesh, resolution: int, finer: bool = True) -> SignedDistance:
    """Exact distances to a closed mesh; an open one is closed by its winding numbers."""
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    extent = float((high - low).max())
    if not (np.isfinite(extent) and extent > 0):
        raise InputError("solid: the mesh is empty or flat", "give a mesh with an inside")
    notes: dict[str, Any] = {"watertight": bool(mesh.is_watertight), "leaks": 0}
    if mesh.is_watertight:
        if finer:
            resolution = _exact_resolution(mesh, triangles, resolution)
        notes["volume_of_mesh"] = abs(float(mesh.volume))
    origin, voxel, size = _grid_of(low, high, resolution)
    if mesh.is_watertight:
        values = signed_distances(triangles, origin + 0.5 * voxel, voxel, size, _BAND)
        start = torch.from_numpy(origin).float()
        return SignedDistance(torch.from_numpy(values), start, voxel, "mesh", notes)
    samples, areas = oriented_samples(triangles, 0.7 * voxel)
    shell = np.zeros(size, dtype=bool)
    shell[tuple(np.floor((samples - origin) / voxel).astype(int).T)] = True
    winding = winding_numbers(
        torch.from_numpy(origin).float() + lattice(size.tolist()) * voxel,
        torch.from_numpy(samples).float(),
        torch.from_numpy(areas).float(),
        soft=0.35 * voxel,
    )
    number = winding.reshape(tuple(size)).numpy()
    if -float(number.min()) > float(number.max()):
        number = -number  # wound inward
    solid, dropped = keep_components(number > _HALF)
    if not solid.any():  # a sheet encloses nothing: it is as thick as a voxel
        solid, dropped = keep_components(shell)
    notes |= find_leaks(shell, solid, origin, voxel) | {"components_dropped": dropped}
    notes |= {"closed_side": None, "closed_by": "winding numbers"}
    return SignedDistance.of_voxels(solid, origin, voxel, "mesh", notes)
