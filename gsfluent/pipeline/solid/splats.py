"""The solid of splats: what they enclose, less what cameras look into, at the voxels it needs.

One decision for everybody: :func:`gsfluent.pipeline.find_solid` returns it, ``Fill`` puts Gaussians
into it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from gsfluent.data import Camera
from gsfluent.pipeline.capture.hull import lattice
from gsfluent.pipeline.solid.evidence import MOST_CAMERAS, Evidence, SolidOptions
from gsfluent.pipeline.solid.field import SignedDistance, distances_of
from gsfluent.pipeline.solid.hollow import hidden_cavity
from gsfluent.pipeline.solid.inside import find_leaks, keep_components
from gsfluent.pipeline.solid.outline import drawn_outlines, mask_outlines, match_outline
from gsfluent.pipeline.solid.tsdf import Fused, depth_views, fuse, fuse_depths
from gsfluent.pipeline.solid.vote import Closed, vote_solid
from gsfluent.pipeline.solid.walls import wall_thickness
from gsfluent.spatial.density import GridBox
from gsfluent.spatial.voxels import distance_transform, grown, surface

_log = logging.getLogger(__name__)

_DRAWN = 0.5  # drawn outlines overhang edges; masks do not (docs/theory/solid.md)
_INNER = 0.05  # share of the surface below the closed one that makes an inner wall
_ENOUGH = 12  # photographs from which depths decide where the skin is
_SKIN = 1.5  # voxels; density and depths may disagree by so much about where the skin is
_CAVITY = 0.02  # share of the solid from which what virtual cameras look into is taken out
_BUBBLE = 0.01  # of the solid: a smaller enclosed void is a fault of the depths
_WALL = 5.0  # voxels a wall should have
_THIN = 0.2  # share of the skin that may stand on thinner walls
_FINER = 2.6  # times: finer than that depths say nothing new
_MOST_VOXELS = 24_000_000
_LIM = 2.0
_MOUTH = 0.5  # of what is hidden: less was a dimple, not the mouth of a vessel
_EVEN = 1.6  # quartiles of a wall's thickness: what varies more is no wall
_BAND = 2.5  # coarse voxels around the skin that are looked at again


def solid_of_splats(
    known: Evidence, method: str, options: SolidOptions
) -> tuple[SignedDistance, str]:
    """Signed distances to the skin of splats, and a word on how they came about.

    Args:
        known: The splats of one object and what saw them.
        method: ``density`` (what the splats enclose), ``tsdf`` (fused depths alone) or ``auto``
            (both).
        options: Settings.
    """
    if method == "tsdf":
        closed = None
        notes: dict[str, Any] = {"stray_gaussians": known.grid[1], "closed_side": None, "leaks": 0}
    else:
        closed = vote_solid(known, options)
        notes = dict(closed.notes)
    box = known.box
    notes["unusable_gaussians"] = known.unusable
    open_side = notes["closed_side"]
    if notes.get("buried_surface_fraction", 0.0) > _INNER:
        open_side = None  # there is a skin inside: the opening is one, not a side nobody saw
    cameras, virtual = known.cameras(box, open_side)
    notes |= {"cameras": len(cameras), "virtual_cameras": virtual}
    note = ""
    if method == "density":
        assert closed is not None
        field = SignedDistance.of_voxels(
            closed.solid, np.array(box.origin), box.voxel, "density", device=known.device
        )
    elif closed is None or (not virtual and len(cameras) >= _ENOUGH):
        field, fused = _seen(known, cameras, closed)
        notes["unseen_surface"] = _unseen(field, fused)
        if closed is not None:
            share = 1.0 - float(field.inside.sum()) / max(1, int(closed.loose.sum()))
            notes["cavity_share"] = max(0.0, share)
            note = f"; depths of {len(cameras)} photographs say where its skin is"
    else:
        field, note = _carved(known, cameras, closed, notes, virtual)
    if closed is not None:
        body = _inside_on(field, box) & closed.loose
        notes |= find_leaks(closed.shell, body, np.array(box.origin), box.voxel)
        if closed.notes["closed_side"] is not None:
            notes["leaks"] = max(1, notes["leaks"])
    if options.finer and method != "density" and field.source != "density":
        field, word = _finer(field, known, closed, open_side)
        note += word
    if options.match_masks and (options.match_drawn or known.masked):
        field = _matched(field, known, cameras, closed)
    return field.replace(report=notes | field.report), note


def _seen(
    known: Evidence, cameras: Sequence[Camera], closed: Closed | None
) -> tuple[SignedDistance, Fused]:
    """Fused depths; where nobody looked, what the splats enclose."""
    from scipy import ndimage

    where = None if closed is None else grown(closed.loose, 3)
    fused = fuse_depths(known.visible, cameras, known.box, where)
    body = fused.values <= 0
    if closed is not None:
        around = ndimage.binary_dilation(closed.loose, iterations=2) & (fused.near > 0)
        body &= closed.loose | around
        if closed.hull is not None:
            body &= closed.hull
    for axis in range(3):  # hidden voxels at the border belong to nothing
        body[(slice(None),) * axis + ([0, -1],)] = False
    body, dropped = keep_components(body)
    body = _without_bubbles(body)
    report: dict[str, Any] = {"components_dropped": dropped}
    if closed is not None:
        body, report["hollow"] = _hollowed(body, closed, fused, known.device)
    field = _field_of(body, fused, known.box, known.device)
    return field.replace(report=report), fused


def _carved(
    known: Evidence,
    cameras: Sequence[Camera],
    closed: Closed,
    notes: dict[str, Any],
    virtual: bool,
) -> tuple[SignedDistance, str]:
    """What the splats enclose, less the cavities that their depths show."""
    from scipy import ndimage

    box, solid, device = known.box, closed.solid, known.device
    fused = fuse_depths(known.visible, cameras, box, grown(solid, 3))
    cavity = _cavities(solid, fused.values, device)
    share = float(cavity.sum() / max(1, int(solid.sum())))
    notes["cavity_share"] = share
    source, note = "density", ""
    report: dict[str, Any] = {}
    if share > _CAVITY:
        if share > 0.5:  # mostly a shell: both of its sides are the depths' to tell
            body = ndimage.binary_dilation(solid) & (fused.values <= 0)
        else:
            body = solid & ~cavity
        solid, dropped = keep_components(body)
        report["components_dropped"] = notes["components_dropped"] + dropped
        source = "density and tsdf"
        note = f"; cameras look into {100 * share:.0f} % of what the ray vote closed"
        solid, report["hollow"] = _hollowed(solid, closed, fused, device)
        field = _field_of(solid, fused, box, device)
    else:
        field = SignedDistance.of_voxels(
            solid, np.array(box.origin), box.voxel, source, device=device
        )
        if notes["closed_side"] is not None and virtual:
            note = "; one side is open and was closed: if it is no hole, choose tsdf"
    return field.replace(source=source, report=report), note


def _hollowed(
    body: np.ndarray, closed: Closed, fused: Fused, device: torch.device
) -> tuple[np.ndarray, str | None]:
    """Without what is hidden behind an opening, and a word on it.

    Only a vessel is hollowed on: what was looked into is at least half as large as what would be
    taken, its wall is of one thickness, and no side of the object is unseen. A dimple, or a ragged
    rim above an underside that nobody photographed, is no mouth.
    """
    hidden, found = hidden_cavity(body, closed.loose, fused.near > 0, device)
    if not found:
        return body, None
    wall = found["wall"] * closed.box.voxel
    share = found["hidden"] / (found["hidden"] + found["seen"])
    vessel = found["free"] >= _MOUTH * int(hidden.sum()) and found["spread"] <= _EVEN
    if closed.notes["closed_side"] is not None or not vessel:
        return body, f"solid where no camera looked; hollow: {wall:.3g} would take that out"
    word = (
        f"cameras see {100 * (1 - share):.0f} % of the cavity's wall, {wall:.3g} thick; "
        "the rest is taken to be as thick"
    )
    _log.info("solid: %s", word)
    return body & ~hidden, word


def _cavities(solid: np.ndarray, depths: np.ndarray, device: torch.device) -> np.ndarray:
    """Parts of the solid that fused depths [voxels] call free, where these go deeper than a skin.

    The density knows the skin better; the depths know what is hollow.
    """
    differing = solid & (depths > 0)
    deep = distance_transform(differing, device) > _SKIN
    result: np.ndarray = grown(deep, 2) & differing
    return result


def _field_of(body: np.ndarray, fused: Fused, box: GridBox, device: torch.device) -> SignedDistance:
    """Distances to the boundary of voxels; near it those of the depths, which are finer."""
    values = distances_of(body, device=device)
    finer = (np.abs(fused.values) < 1.0) & ((fused.values <= 0) == body) & (fused.near > 0)
    values = np.where(finer, fused.values, values)
    return SignedDistance(
        torch.from_numpy((values * box.voxel).astype(np.float32)).to(device),
        torch.tensor(box.origin, device=device),
        box.voxel,
        "tsdf",
    )


def _without_bubbles(body: np.ndarray) -> np.ndarray:
    """Fill enclosed voids too small to be meant; a large one was looked into through a slit."""
    from scipy import ndimage

    bubbles = ndimage.binary_fill_holes(body) & ~body
    if not bubbles.any():
        return body
    label, count = ndimage.label(bubbles)
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    small = sizes < _BUBBLE * float(body.sum())
    small[0] = False
    result: np.ndarray = body | small[label]
    return result


def _unseen(field: SignedDistance, fused: Fused) -> float:
    """Share of the surface that no camera saw: there the boundary is a guess."""
    skin = surface(field.inside.cpu().numpy())
    return float((skin & (fused.known == 0)).sum() / max(1, int(skin.sum())))


def _inside_on(field: SignedDistance, box: GridBox) -> np.ndarray:
    """The inside of a field at the voxel centres of a grid, bool [X, Y, Z]."""
    centers = box.centers(np.argwhere(np.ones(box.shape, dtype=bool)))
    inside: np.ndarray = (field.at(torch.from_numpy(centers).float()) <= 0).cpu().numpy()
    return inside.reshape(box.shape)


def _finer(
    field: SignedDistance,
    known: Evidence,
    closed: Closed | None,
    open_side: Sequence[float] | None,
) -> tuple[SignedDistance, str]:
    """The field on a finer grid where its walls ask for one; only its skin is looked at again."""
    from scipy import ndimage

    coarse = field.voxel
    _, thickness = wall_thickness(field, 12.0 * coarse)
    if len(thickness) == 0:
        return field, ""
    wall = max(float(thickness.double().quantile(_THIN)), coarse)
    size = torch.tensor(field.values.shape).double()
    room = (_MOST_VOXELS / float(size.prod())) ** (1.0 / 3.0)
    factor = min(_WALL * coarse / wall, _FINER, room)
    if factor < 1.1:
        return field, ""
    voxel = coarse / factor
    shape = (size * factor).ceil().long().tolist()
    device = field.values.device
    box = GridBox.of(field.origin, voxel, shape)
    near = (field.values.abs() < _BAND * coarse).cpu().numpy()
    if closed is not None and closed.shell.shape == near.shape:
        near |= ndimage.binary_dilation(closed.shell)
    axes = [
        np.minimum(((np.arange(n) + 0.5) / factor).astype(int), m - 1)
        for n, m in zip(shape, near.shape, strict=True)
    ]
    band = near[np.ix_(*axes)]
    index = np.argwhere(band)
    points = torch.from_numpy(box.centers(index)).float()
    pixels = int(min(2.5 * max(shape), 640))
    cameras, _ = known.cameras(box, open_side, pixels, 2 * MOST_CAMERAS)
    views = depth_views(known.visible, cameras)
    found = fuse(points.to(known.visible.means), views, voxel, _LIM * factor)
    before = (field.at(points) / voxel).cpu().numpy()
    # far from the coarse skin the depths only repeat it; hidden is hidden
    values = np.where((found.known > 0) | (before > 0), found.values, before)
    if closed is not None:
        values = np.maximum(values, before - _BAND * factor)
    inside = field.inside.cpu().numpy()[np.ix_(*axes)]
    body = inside.copy()
    body[band] = values <= 0
    body, dropped = keep_components(body)
    body = _without_bubbles(body)
    fused = Fused(values, found.near, found.known).on_grid(band, 2.0)
    result = _field_of(body, fused, box, device)
    report = field.report | {
        "components_dropped": field.report.get("components_dropped", 0) + dropped,
        "finer": round(factor, 2),
        "finer_for_wall": wall,
    }
    word = f"; voxels {factor:.1f} times finer for walls of {wall:.3g}"
    _log.info("solid%s", word)
    return result.replace(source=field.source, report=report), word


def _matched(
    field: SignedDistance,
    known: Evidence,
    cameras: Sequence[Camera],
    closed: Closed | None,
) -> SignedDistance:
    """The field with the outline that masks show, or the splats when there are none."""
    if not known.masked:
        grown, offset = match_outline(field, drawn_outlines(known.visible, cameras), trust=_DRAWN)
        notes = {"skin_offset": offset, "skin_from": "splats"}
        return grown.replace(report=field.report | notes)
    assert known.capture is not None  # masked
    grown, offset = match_outline(field, mask_outlines(known.capture))
    if offset < 0:
        # an outline is the envelope of all bumps; half of what it asks for is theirs
        offset = round(_DRAWN * offset, 3)
        grown = field.replace(values=field.values - offset * field.voxel)
    values = grown.values
    if offset > 0 and closed is not None and closed.hull is not None:
        # what was added must lie in the masks as well
        bound = SignedDistance.of_voxels(
            closed.hull, np.array(known.box.origin), known.box.voxel, "hull",
            device=values.device,
        )  # fmt: skip
        places = field.origin + lattice(values.shape, values.device) * field.voxel
        allowed = bound.at(places).reshape(values.shape)
        values = torch.maximum(values, torch.minimum(allowed, field.values))
    notes = {"skin_offset": offset, "skin_from": "masks"}
    return grown.replace(values=values, report=field.report | notes)
