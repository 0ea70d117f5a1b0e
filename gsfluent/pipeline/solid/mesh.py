"""A closed triangle mesh of an object's solid, for programs that know no splats."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsfluent.data import BACKGROUND, Gaussians
from gsfluent.errors import InputError, RunError, need
from gsfluent.io import atomic_path, load_capture, load_splats
from gsfluent.io.solid import load_solid, volume_path
from gsfluent.pipeline.solid.colors import surface_colors
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.source import find_solid
from gsfluent.spatial.mesh_file import is_mesh

if TYPE_CHECKING:
    import trimesh


_log = logging.getLogger(__name__)

FORMATS = ("obj", "ply", "glb", "stl")


def closed_mesh(field: SignedDistance, gaussians: Gaussians | None = None) -> trimesh.Trimesh:
    """The surface where the distance is zero, by marching cubes (Lewiner et al. 2003).

    The rim of the field is outside, so the surface is closed; its normals point out.

    Args:
        field: The solid.
        gaussians: Splats that give the vertices their colours; none without.

    Raises:
        InputError: Nothing is inside, or scikit-image is not installed.
        RunError: The surface is not closed (a failure of marching cubes).
    """
    import trimesh

    measure = need("skimage.measure", "mesh", "mesh: the surface")
    if not bool(field.inside.any()):
        raise InputError("mesh: the solid is empty", "check the input, or choose another method")
    values = np.pad(field.values.cpu().numpy(), 1, constant_values=_rim(field))
    vertices, faces, _, _ = measure.marching_cubes(values, level=0.0)
    # the pad is one voxel, and values are those of voxel centres
    vertices = field.origin.double().cpu().numpy() + (vertices - 0.5) * field.voxel
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces(height=0.0))
    if mesh.volume < 0:
        mesh.invert()
    if not mesh.is_watertight:
        raise RunError(
            f"mesh: the surface has open edges at voxel {field.voxel:.3g}",
            hint="try another resolution, and report it",
        )
    if gaussians is not None and gaussians.count:
        color = surface_colors(gaussians, np.asarray(mesh.vertices), field.voxel)
        mesh.visual.vertex_colors = np.concatenate(  # type: ignore[union-attr]
            [(color * 255).round().astype(np.uint8), np.full((len(color), 1), 255, np.uint8)], 1
        )
    return mesh


def _rim(field: SignedDistance) -> float:
    """A positive distance to put around the grid."""
    return float(field.values.abs().amax().clamp(field.voxel, 1e3 * field.voxel))


def save_mesh(mesh: trimesh.Trimesh, path: str | Path, *, scale: float = 1.0) -> None:
    """Write a mesh atomically; the ending chooses the format.

    Args:
        mesh: The mesh.
        path: ``.obj``, ``.ply``, ``.glb`` or ``.stl`` (which has no colours).
        scale: Metres, or whatever the file's unit shall be, per world unit.

    Raises:
        InputError: Another ending, or a scale that is not positive.
        RunError: The disk is full.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise InputError(f"-o {path}", f"end the name with {', '.join('.' + k for k in FORMATS)}")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"--scale {scale}", "give a positive number")
    if scale != 1.0:
        mesh = mesh.copy()
        mesh.apply_scale(scale)
    with atomic_path(path) as part:
        mesh.export(part, file_type=kind)


def mesh_to(
    source: Path,
    out: Path,
    *,
    capture: Path | None = None,
    method: str = "auto",
    resolution: int = 96,
    scale: float = 1.0,
) -> dict[str, Any]:
    """A splat file, a solid, a masked capture or a mesh to a closed mesh.

    Args:
        source: Splat ``.ply``, solid of ``gsfluent fill``, capture folder, or mesh file.
        out: File to write, see :func:`save_mesh`.
        capture: Photographs that the splats were made from.
        method: See :func:`gsfluent.pipeline.solid.source.find_solid`.
        resolution: Voxels along the longest side.
        scale: Units of the file per world unit.

    Returns:
        ``source`` (what the solid was taken from), ``why``, ``vertices``, ``faces``,
        ``watertight``, ``volume``, ``leaks``, ``seconds``, ``output``.

    Raises:
        InputError: The input cannot be read, or has no inside.
        RunError: The disk is full.
    """
    if out.suffix.lower().lstrip(".") not in FORMATS:
        raise InputError(f"-o {out}", f"end the name with {', '.join('.' + k for k in FORMATS)}")
    began = time.perf_counter()
    photographs = None if capture is None else load_capture(capture)
    gaussians = None
    if source.is_dir():
        field = find_solid(None, load_capture(source), method=method, resolution=resolution)
    elif is_mesh(source):
        field = find_solid(mesh=source, method=method, resolution=resolution)
    elif method == "auto" and volume_path(source).is_file():
        solid = load_solid(source)
        field, gaussians = SignedDistance.of_solid(solid), solid.gaussians
        field.report["why"] = "the solid is decided already"
    else:
        gaussians = load_splats(source).validated(source.name)
        if gaussians.labels is not None and bool((gaussians.labels != BACKGROUND).any()):
            gaussians = gaussians.select(gaussians.labels != BACKGROUND)
        field = find_solid(gaussians, photographs, method=method, resolution=resolution)
    mesh = closed_mesh(field, gaussians)
    save_mesh(mesh, out, scale=scale)
    _log.info("mesh: %d faces from %s", len(mesh.faces), field.source)
    return {
        "source": field.source,
        "why": field.report.get("why"),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": bool(mesh.is_watertight),
        "volume": float(mesh.volume) * scale**3,
        "leaks": field.report.get("leaks"),
        "closed_side": field.report.get("closed_side"),
        "seconds": time.perf_counter() - began,
        "output": str(out),
    }
