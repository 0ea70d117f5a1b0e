"""Solids of about the right size, shape and place, before there is any reconstruction.

Splats are filled coarsely. Photographs with masks are carved to their visual hull. Without masks
the sparse points say how large the object is, and an ellipsoid is its proxy.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gsfluent.config import Shot
from gsfluent.data import SURFACE, Capture, Frame, Gaussians, Solid, View
from gsfluent.errors import InputError, RunError
from gsfluent.inspection.capture import inspect
from gsfluent.io import load_capture, load_splats, write_json
from gsfluent.io.solid import load_solid, save_solid
from gsfluent.pipeline.capture.hull import hull_grid, masked_views
from gsfluent.pipeline.capture.orient import DEFAULT_SIZE, look_at_point, make_frame
from gsfluent.pipeline.fill.mesh_skin import SPLATS, mesh_gaussians
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.reconstruct.recipe import recipe_for
from gsfluent.plan.cost import cache_folder
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.spatial.voxels import nearest_empty
from gsfluent.stages.known import extended, is_solid, known_solid, parted, source_digest
from gsfluent.stages.select import select_mask

if TYPE_CHECKING:
    from collections.abc import Mapping

_log = logging.getLogger(__name__)

_VOXELS = 48
_FACTS, _MOST = "proxy.json", 8  # file beside the solids, and proxies that are kept
_MESH_SPLATS = 5000  # enough for the box and the axes of a mesh
_MARGIN = 8
"""Pixels that training keeps around a mask."""
_SOLID_SHARE = 0.75
"""Volume of a filled object over that of the ellipsoid in the box of its sparse points: the mean
over the two of the gallery without masks (apple 0.81, skull 0.70)."""


@dataclasses.dataclass(frozen=True)
class Photographs:
    """What training will look at."""

    images: int  # How many photographs
    source_pixels: float  # Pixels of all their files
    pixels: float  # Pixels of one at the size of training, mean
    object_pixels: float  # Those of the part that shows the object, mean
    masked: bool  # Whether there are masks


@dataclasses.dataclass(frozen=True)
class Proxy:
    """What a shot is planned with before there is any reconstruction."""

    solids: Mapping[str, Solid]  # Solid of each object by name, in the coordinates of the input
    frame: Frame  # From there to the scene
    assumed: str  # Where they come from, in words
    photographs: Photographs | None = None  # None when the shot starts from splats
    splats: int | None = None  # Splats of the object, when they are known


def proxy(shot: Shot, warnings: list[str]) -> Proxy:
    """Solids to plan a shot with.

    Those of splats and meshes are kept in the user's cache: a plan, the run after it and the run
    that is taken up again fill them once.

    Raises:
        InputError: The input cannot be read, or an object selects nothing of it.
    """
    if shot.splats is not None or shot.mesh is not None:
        if is_solid(shot.splats):  # nothing is filled
            return _of_surface(shot)
        folder = cache_folder() / "proxies" / _key(shot)
        found = _kept(folder, list(shot.objects))
        if found is None:
            found = _of_surface(shot)
            _keep(found, folder)
        return found
    return _of_photographs(shot, warnings)


def _key(shot: Shot) -> str:
    """Fingerprint of all that a proxy of splats or a mesh hangs on."""
    placing = (shot.scale, shot.size, shot.up, shot.front, shot.floor, shot.origin)
    selections = {name: repr(o.select) for name, o in shot.objects.items()}
    labels = [content_digest(o.select.labels) for o in shot.objects.values() if o.select.labels]
    inputs = [source_digest(shot), repr(shot.fill), repr(placing), selections, labels]
    return fingerprint("proxy", _VOXELS, inputs)


def _kept(folder: Path, names: list[str]) -> Proxy | None:
    """The proxy that lies in a folder of the cache, if a whole one does."""
    try:
        facts = json.loads((folder / _FACTS).read_text(encoding="utf-8"))
        frame = Frame.from_dict(facts["frame"])
        solids = {name: load_solid(folder / f"{i}.ply") for i, name in enumerate(names)}
        found = Proxy(solids, frame, facts["assumed"], splats=facts["splats"])
        os.utime(folder)  # those looked at last are kept
    except (OSError, ValueError, KeyError, TypeError, InputError):
        return None
    return found


def _keep(made: Proxy, folder: Path) -> None:
    """Put a proxy into the cache, whole or not at all, and drop those not looked at for long."""
    facts = {"frame": made.frame.to_dict(), "assumed": made.assumed, "splats": made.splats}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as place:
            part = Path(place) / folder.name
            part.mkdir()
            for i, solid in enumerate(made.solids.values()):
                save_solid(solid, part / f"{i}.ply")
            write_json(part / _FACTS, facts)
            shutil.rmtree(folder, ignore_errors=True)
            part.replace(folder)
        others = [path for path in folder.parent.iterdir() if not path.name.startswith(".")]
        for old in sorted(others, key=lambda path: path.stat().st_mtime)[:-_MOST]:
            shutil.rmtree(old, ignore_errors=True)
    except (OSError, RunError) as error:  # a cache is no reason to stop
        _log.debug("proxy not kept: %s", error)


def _of_surface(shot: Shot) -> Proxy:
    """Proxies from splats, or a mesh."""
    if shot.mesh is not None:
        gaussians = mesh_gaussians(shot.mesh, _MESH_SPLATS)
    else:
        assert shot.splats is not None
        gaussians = load_splats(shot.splats).validated(shot.splats.name)
    frame = make_frame(gaussians, None, shot)
    options = shot.fill.given(frame.scale) | {"resolution": _VOXELS}
    masks = {}
    taken = torch.zeros(gaussians.count, dtype=torch.bool)
    for name, settings in shot.objects.items():
        masks[name] = select_mask(gaussians, settings.select, frame) & ~taken
        taken |= masks[name]
    whole = known_solid(shot, gaussians, options | {"finer": False})
    if whole is not None:
        masks = {name: extended(mask, gaussians, whole.gaussians) for name, mask in masks.items()}
        known = {name: _grey(solid) for name, solid in parted(whole, masks).items()}
        told = "the solid as it is" if shot.mesh is None else f"the mesh at {_VOXELS} voxels"
        count = gaussians.count if shot.mesh is None else SPLATS
        return Proxy(known, frame, told, splats=count)
    solids = {
        name: _grey(Fill(**options, refine_views=0)(gaussians.select(mask)))
        for name, mask in masks.items()
    }
    what = f"the splat, filled at {_VOXELS} voxels"
    return Proxy(solids, frame, what, splats=gaussians.count)


def _of_photographs(shot: Shot, warnings: list[str]) -> Proxy:
    """Proxies from the photographs of a capture."""
    if shot.capture is None:
        raise InputError("the shot has no capture, splats or mesh", "name one input")
    # what is wrong with a capture is an error; what is not in it is a warning
    capture = load_capture(shot.capture)
    views = masked_views(capture)
    if len(views) >= 3:
        grid, inside = hull_grid(views, capture, look_at_point(capture.cameras), _VOXELS)
        if inside.any():
            photographs = look_at_photographs(shot, capture, views)
            return _carved(shot, capture, grid, inside, photographs)
    try:
        report = inspect(shot.capture, None, size=shot.size)
    except InputError as error:
        size = shot.size or DEFAULT_SIZE
        warnings.append(
            f"the object's size is not known ({error.what}): assumed {size:g} m; hint: add masks "
            "or sparse points to the capture"
        )
        box, what = [size] * 3, f"a ball of {size:g} m"
        photographs = look_at_photographs(shot, capture, [])
    else:
        box = [float(x) for x in report["box"]["size"]]
        unit = float(report["scale"]["metres_per_unit"])
        photographs = look_at_photographs(shot, capture, [], max(box) / unit)
        if shot.scale is not None:
            box = [x * shot.scale / unit for x in box]
        what = "an ellipsoid in the box of what is seen"
        if len(shot.objects) > 1:
            warnings.append(
                "objects are told apart only in the reconstruction: each is planned as the whole; "
                "hint: add masks to the capture"
            )
    solids = dict.fromkeys(shot.objects, _ellipsoid(box, _SOLID_SHARE))
    return Proxy(solids, Frame.identity(), what, photographs)


def look_at_photographs(
    shot: Shot, capture: Capture, views: list[View], extent: float | None = None
) -> Photographs:
    """What training will look at.

    Args:
        shot: For the size of the photographs.
        capture: The capture.
        views: Some of its photographs, small, with masks; or none.
        extent: Size of the object [world units], used without masks.
    """
    wanted = shot.reconstruct
    recipe = recipe_for(wanted.recipe or "auto", wanted.iterations or 800)
    most = wanted.image_size or recipe.image_size
    shrink = [min(1.0, most / max(c.width, c.height)) for c in capture.cameras]
    sizes = [c.width * c.height for c in capture.cameras]
    pixels = float(np.mean([n * s * s for n, s in zip(sizes, shrink, strict=True)]))
    shown = []
    for view in views:
        mask = view.mask
        assert mask is not None  # from masked_views
        full = max(capture.cameras[0].width, capture.cameras[0].height)
        zoom = min(most, full) / max(mask.shape)
        rows, columns = ((mask > 0.02).any(axis).nonzero()[:, 0] for axis in (1, 0))
        if len(rows):
            sides = [float(line[-1] - line[0] + 1) * zoom for line in (columns, rows)]
            limits = (mask.shape[1] * zoom, mask.shape[0] * zoom)
            sides = [min(s + 2 * _MARGIN, limit) for s, limit in zip(sides, limits, strict=True)]
            shown.append(sides[0] * sides[1])
    if not shown and extent is not None:
        focus = torch.from_numpy(look_at_point(capture.cameras))
        for camera, s in zip(capture.cameras, shrink, strict=True):
            depth = float((camera.center() - focus).norm())
            side = s * float(camera.K[0, 0]) * extent / max(depth, 1e-9) + 2 * _MARGIN
            shown.append(min(side, s * camera.width) * min(side, s * camera.height))
    return Photographs(
        images=len(capture),
        source_pixels=float(sum(sizes)),
        pixels=pixels,
        object_pixels=float(np.mean(shown)) if shown else pixels,
        masked=bool(views),
    )


def _carved(
    shot: Shot, capture: Capture, grid: np.ndarray, inside: np.ndarray, photographs: Photographs
) -> Proxy:
    """Proxies from the voxels of a hull, selected as the splats of a run are."""
    occupied = torch.from_numpy(inside)
    points = torch.from_numpy(grid)[occupied].float()
    step = (grid[-1, -1, -1] - grid[0, 0, 0]) / (len(grid) - 1)
    radius = torch.full((len(points), 3), 0.5 * float(np.prod(step) ** (1 / 3)))
    whole = Gaussians.from_colors(
        points, radius, torch.full((len(points), 3), 0.5), opacities=0.9, label=SURFACE
    )
    frame = make_frame(whole, capture, shot)
    taken = torch.zeros(whole.count, dtype=torch.bool)
    solids = {}
    for name, settings in shot.objects.items():
        select = dataclasses.replace(settings.select, color_near=None, labels=None)
        mask = select_mask(whole, select, frame) & ~taken
        if not bool(mask.any()):
            raise InputError(
                f"objects.{name}.select: nothing of the hull of the photographs is selected",
                "look at the box in `gsfluent inspect` and widen the conditions",
            )
        taken |= mask
        solids[name] = _solid_of(occupied, mask, grid, step)
    return Proxy(solids, frame, "the visual hull of the photographs", photographs)


def _solid_of(occupied: Tensor, mask: Tensor, grid: np.ndarray, step: np.ndarray) -> Solid:
    """A solid with cubic voxels from chosen points of a lattice."""
    chosen = torch.zeros_like(occupied)
    chosen[occupied] = mask
    places = torch.from_numpy(grid)[chosen]
    voxel = float(step.max())
    low, high = places.amin(0) - 0.5 * torch.from_numpy(step), places.amax(0)
    high = high + 0.5 * torch.from_numpy(step)
    counts = torch.ceil((high - low) / voxel).long() + 2
    origin = low - voxel
    axes = [origin[d] + (torch.arange(int(counts[d])) + 0.5) * voxel for d in range(3)]
    centers = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    first = torch.from_numpy(grid[0, 0, 0])
    index = ((centers - first) / torch.from_numpy(step)).round().long()
    fits = ((index >= 0) & (index < len(grid))).all(-1)
    index = index.clamp(0, len(grid) - 1)
    matter = chosen[index[..., 0], index[..., 1], index[..., 2]] & fits
    distance, _ = nearest_empty(matter.numpy(), torch.device("cpu"))
    depth = torch.from_numpy(distance).float().sub(0.5).clamp(min=0.0) * voxel
    return _grey(_with_one_splat(matter, depth, origin.float(), voxel))


def _ellipsoid(size: list[float], share: float = 1.0) -> Solid:
    """An ellipsoid that stands on z = 0 and fills a box of ``size`` [m], but for its core.

    What dents, hollows and legs leave out of a box is left out of the middle: ``share`` is what
    stays of the volume.
    """
    extents = torch.tensor(size, dtype=torch.float32).clamp(min=1e-6)
    voxel = float(extents.amax()) / _VOXELS
    counts = [max(2, math.ceil(float(e) / voxel)) for e in extents]
    axes = [(torch.arange(n) + 0.5) / n * 2.0 - 1.0 for n in counts]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    level = x * x + y * y + z * z
    inside = (level <= 1.0) & (level.sqrt() >= (1.0 - share) ** (1 / 3))
    origin = torch.tensor([-0.5, -0.5, 0.0]) * extents
    depth = (1.0 - level.sqrt()).clamp(min=0.0) * 0.5 * float(extents.amin())
    return _grey(_with_one_splat(inside, depth, origin, voxel))


def _with_one_splat(inside: Tensor, depth: Tensor, origin: Tensor, voxel: float) -> Solid:
    middle = (origin + 0.5 * voxel * torch.tensor(inside.shape))[None]
    one = Gaussians.from_colors(
        middle, torch.full((1,), voxel), torch.full((1, 3), 0.5), label=SURFACE
    )
    return Solid(one, inside, depth, origin, voxel)


def _grey(solid: Solid) -> Solid:
    """With a neutral colour everywhere, so that parts chosen by colour can be asked for."""
    if solid.color is not None:
        return solid
    return dataclasses.replace(solid, color=torch.full((*solid.occupancy.shape, 3), 0.5))
