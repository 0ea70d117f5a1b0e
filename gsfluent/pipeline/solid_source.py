"""Where an object's solid comes from: masks, the density of its splats, their depths, or a mesh."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gsfluent.data import Camera, Capture, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.fill import Fill
from gsfluent.pipeline.fill_density import GridBox, choose_grid
from gsfluent.pipeline.fill_inside import cast_votes, count_leaks, keep_components
from gsfluent.pipeline.fill_inside import visual_hull as centre_hull
from gsfluent.pipeline.mesh_distance import load_mesh, signed_distances, surface_samples
from gsfluent.pipeline.reconstruct_init import visual_hull
from gsfluent.pipeline.reconstruct_views import read_views
from gsfluent.pipeline.solid_field import SignedDistance, distances_of
from gsfluent.pipeline.solid_skin import drawn_outlines, mask_outlines, match_outline
from gsfluent.pipeline.solid_tsdf import fuse_depths, ring_of_cameras, zoomed

if TYPE_CHECKING:
    import trimesh

__all__ = ["METHODS", "find_solid"]

_log = logging.getLogger(__name__)

METHODS = ("auto", "hull", "density", "tsdf", "mesh")
_HULL_SIZE = 400  # pixels of the masks
_CAVITY = 0.02  # share of the solid from which what cameras look into is taken out
_SKIN = 1.5  # voxels; density and depths may disagree by so much about where the skin is
_DRAWN = 0.5  # drawn outlines overhang edges; masks do not (docs/solid.md)
_FAINT = 0.05  # opacity below which a splat is no matter
_AGREE = 0.7  # share of the rays that must meet an open mesh
_BAND = 3.0  # voxels around a mesh with exact distances
_FEW_VIEWS = 8  # cameras below which a hull is a cone


def find_solid(
    gaussians: Gaussians | None = None,
    capture: Capture | None = None,
    mesh: trimesh.Trimesh | str | Path | None = None,
    *,
    method: str = "auto",
    resolution: int = 96,
    seed: int = 0,
) -> SignedDistance:
    """Signed distances to the surface of an object, from whatever there is.

    Args:
        gaussians: The object's splats (without background), or None.
        capture: Its photographs, with masks for ``hull``; cameras for ``tsdf``.
        mesh: A triangle mesh, or a file that trimesh reads.
        method: ``hull`` (visual hull of the masks), ``density`` (opacity density and ray vote, cut
            by the hull where there are masks), ``tsdf`` (fused depths of the splats), ``mesh``, or
            ``auto``: the mesh when there is one, else the density of the splats less the cavities
            that their depths show, else the hull.
        resolution: Voxels along the longest side of the object.
        seed: Seed of the density's lattice; the result hardly knows it.

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
    chosen, why = _choose(method, gaussians, capture, mesh)
    began = time.perf_counter()
    if chosen == "mesh":
        assert mesh is not None
        field = _of_mesh(mesh if not isinstance(mesh, str | Path) else load_mesh(mesh), resolution)
    elif chosen == "hull":
        assert capture is not None
        field = _of_hull(capture, resolution)
    elif chosen == "tsdf":
        assert gaussians is not None
        field = _of_depths(gaussians, capture, resolution)
    else:
        assert gaussians is not None
        carve = method == "auto"
        field, note = _of_density(gaussians, capture, resolution, seed, carve=carve)
        why += note
    if chosen != "mesh":
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


def _choose(
    method: str,
    gaussians: Gaussians | None,
    capture: Capture | None,
    mesh: Any,
) -> tuple[str, str]:
    """Which source, and why."""
    masks = capture is not None and _has_masks(capture)
    needs = {"hull": masks, "density": gaussians is not None, "tsdf": gaussians is not None}
    if method != "auto":
        if not needs.get(method, mesh is not None):
            what = {"hull": "a capture with masks", "mesh": "a mesh"}.get(method, "splats")
            raise InputError(f"solid: method {method} needs {what}", "give it, or leave auto")
        return method, "asked for"
    if mesh is not None:
        return "mesh", "a mesh is exact"
    if gaussians is not None:
        reason = "splats, and masks to cut them by" if masks else "splats, no masks"
        return "density", reason
    if masks:
        return "hull", "masks and no splats"
    raise InputError("solid: neither splats, nor masks, nor a mesh were given", "give one of them")


def _of_hull(capture: Capture, resolution: int) -> SignedDistance:
    """The conservative hull says where; voxel centres against the masks say exactly how far."""
    views = read_views(capture, _HULL_SIZE, torch.device("cpu"), crop=True)
    rough = visual_hull(views, resolution)
    origin = rough.origin.double().cpu().numpy()
    x, y, z = rough.occupancy.shape
    box = GridBox((float(origin[0]), float(origin[1]), float(origin[2])), rough.voxel, (x, y, z))
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
    return SignedDistance.of_voxels(body, origin, rough.voxel, "hull", notes)


def _of_density(
    gaussians: Gaussians, capture: Capture | None, resolution: int, seed: int, *, carve: bool
) -> tuple[SignedDistance, str]:
    """Where rays meet splats all around; less what cameras look into. And a word on that."""
    from scipy import ndimage

    gaussians = gaussians.validated("solid")
    box, solid, notes = Fill(resolution, match_masks=False, seed=seed).inside(gaussians, capture)
    source, note = "density", ""
    cameras, views = _lookers(capture, box, notes["closed_side"])
    visible = gaussians.select(gaussians.opacities > _FAINT)
    notes |= views
    if carve:
        fused = fuse_depths(visible, cameras, box)
        cavity = _cavities(solid, fused.values)
        share = float(cavity.sum() / max(1, int(solid.sum())))
        notes["cavity_share"] = share
        if share > _CAVITY:
            if share > 0.5:  # mostly a shell: both of its sides are the depths' to tell
                body = ndimage.binary_dilation(solid) & (fused.values <= 0)
            else:
                body = solid & ~cavity
            solid, dropped = keep_components(body)
            notes["components_dropped"] += dropped
            source = "density and tsdf"
            note = f"; cameras look into {100 * share:.0f} % of what the ray vote closed"
        elif notes["closed_side"] is not None and views["virtual_cameras"]:
            note = "; one side is open and was closed: if it is no hole, choose tsdf"
    field = SignedDistance.of_voxels(solid, np.array(box.origin), box.voxel, source, notes)
    return _matched(field, visible, capture, cameras), note


def _cavities(solid: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Parts of the solid that fused depths [voxels] call free, where these go deeper than a skin.

    The density knows the skin better; the depths know what is hollow.
    """
    from scipy import ndimage

    differing = solid & (depths > 0)
    deep = ndimage.distance_transform_edt(differing) > _SKIN
    grown = ndimage.binary_dilation(deep, np.ones((3, 3, 3)), iterations=2)
    result: np.ndarray = grown & differing
    return result


def _lookers(
    capture: Capture | None, box: GridBox, open_side: Sequence[float] | None
) -> tuple[list[Camera], dict[str, Any]]:
    """Cameras of the capture cut to the object, else a ring of cameras around it.

    No camera of the ring looks from an open side: it would see the inside of the far skin.
    """
    low, size = torch.tensor(box.origin), torch.tensor(box.shape) * box.voxel
    center, radius = low + 0.5 * size, 0.5 * float(size.norm())
    cameras: list[Camera] = []
    if capture is not None:
        near = [zoomed(camera, center, radius) for camera in capture.cameras]
        cameras = [camera for camera in near if camera is not None]
    virtual = not cameras
    if virtual:
        cameras = ring_of_cameras(center, radius)
        if open_side is not None:
            side = torch.tensor(open_side, dtype=torch.float64)
            cameras = [c for c in cameras if float(c.forward() @ side) > -0.1]
    return cameras, {"cameras": len(cameras), "virtual_cameras": virtual}


def _of_depths(gaussians: Gaussians, capture: Capture | None, resolution: int) -> SignedDistance:
    gaussians = gaussians.validated("solid")
    box, strays = choose_grid(gaussians.means, gaussians.opacities, resolution)
    cameras, views = _lookers(capture, box, None)
    visible = gaussians.select(gaussians.opacities > _FAINT)
    fused = fuse_depths(visible, cameras, box)
    body = fused.values <= 0
    for axis in range(3):  # hidden voxels at the border belong to nothing
        body[(slice(None),) * axis + ([0, -1],)] = False
    occupied, dropped = keep_components(body)
    values = distances_of(occupied)
    # Near the surface the depths know it finer than the voxels do.
    finer = (np.abs(fused.values) < 1.0) & ((fused.values <= 0) == occupied)
    values = np.where(finer, fused.values, values)
    notes = {
        **views,
        "components_dropped": dropped,
        "stray_gaussians": strays,
        "unseen_surface": _unseen(occupied, fused.known),
        "leaks": 0,
    }
    field = SignedDistance(
        torch.from_numpy((values * box.voxel).astype(np.float32)),
        torch.tensor(box.origin, dtype=torch.float32),
        box.voxel,
        "tsdf",
        notes,
    )
    return _matched(field, visible, capture, cameras)


def _matched(
    field: SignedDistance,
    visible: Gaussians,
    capture: Capture | None,
    cameras: Sequence[Camera],
) -> SignedDistance:
    """The field with the outline that masks show, or the splats when there are none."""
    if capture is None or not _has_masks(capture):
        grown, offset = match_outline(field, drawn_outlines(visible, cameras), trust=_DRAWN)
        notes = {"skin_offset": offset, "skin_from": "splats"}
        return grown.replace(report=field.report | notes)
    grown, offset = match_outline(field, mask_outlines(capture))
    notes = {"skin_offset": offset, "skin_from": "masks"}
    values = grown.values
    if offset > 0:  # what was added must lie in the masks as well
        hull = _of_hull(capture, max(field.values.shape))
        axes = [torch.arange(n) + 0.5 for n in field.values.shape]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        bound = hull.at(field.origin + grid * field.voxel).reshape(values.shape)
        values = torch.maximum(values, torch.minimum(bound, field.values))
    return grown.replace(values=values, report=field.report | notes)


def _has_masks(capture: Capture) -> bool:
    return capture.has_masks or capture.view(0, 64).mask is not None


def _unseen(occupied: np.ndarray, known: np.ndarray) -> float:
    """Share of the surface that no camera saw: there the boundary is a guess."""
    from scipy import ndimage

    skin = occupied & ~ndimage.binary_erosion(occupied)
    return float((skin & (known == 0)).sum() / max(1, int(skin.sum())))


def _of_mesh(mesh: trimesh.Trimesh, resolution: int) -> SignedDistance:
    """Exact distances to a closed mesh; an open one is voxelised and closed by a ray vote."""
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    extent = float((high - low).max())
    if not (np.isfinite(extent) and extent > 0):
        raise InputError("solid: the mesh is empty or flat", "give a mesh with an inside")
    voxel = extent / max(resolution - 1, 1)
    size = np.ceil((high - low) / voxel).astype(int) + 7
    origin = 0.5 * (low + high) - 0.5 * size * voxel
    notes: dict[str, Any] = {"watertight": bool(mesh.is_watertight), "leaks": 0}
    if mesh.is_watertight:
        values = signed_distances(triangles, origin + 0.5 * voxel, voxel, size, _BAND)
        start = torch.from_numpy(origin).float()
        return SignedDistance(torch.from_numpy(values), start, voxel, "mesh", notes)
    shell = np.zeros(size, dtype=bool)
    samples = surface_samples(triangles, 0.5 * voxel)
    shell[tuple(np.floor((samples - origin) / voxel).astype(int).T)] = True
    vote = cast_votes(shell)
    solid, dropped = keep_components(shell | (vote.score >= _AGREE))
    leaks, wet = count_leaks(shell, solid)
    notes |= {"leaks": leaks, "leaking_voxels": wet, "components_dropped": dropped}
    notes["closed_side"] = None if vote.open_side is None else list(vote.open_side)
    return SignedDistance.of_voxels(solid, origin, voxel, "mesh", notes)
