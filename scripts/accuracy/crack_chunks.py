"""What chunks promise, measured on the broken objects of ``cracks.py`` and on flat cuts.

Volumes, places of the points, overlap and holes as drawn; the change of the picture when a piece is
seen to split and nothing else happens; heights and time of the partition itself.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import torch
from crack_cases import Broken, drawn
from torch import Tensor

from gsfluent.data import INTERIOR, Camera, Frame, Gaussians, Solid
from gsfluent.draw import draw
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.cracks.ease import FRAMES
from gsfluent.pipeline.cracks.gaps import Cracks
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.points import sample_points
from gsfluent.pipeline.partition.tree import Partition
from gsfluent.pipeline.render.camera import Action, look_at
from gsfluent.pipeline.render.figures import cameras_around
from gsfluent.pipeline.render.holes import Holes, MatterView
from gsfluent.results.partition import SavedPartition

AROUND = tuple((30.0 * k, 15.0) for k in range(12))
"""Azimuth and elevation of the cameras around [degrees]."""
_PIECE = 64  # points from which on a part is a piece and no chip
_NEAR = 12  # drawn voxels among which one of another piece is looked for
_POPS = 2  # splits into pieces of which pictures are made, at most
_SLABS = 8


def chunk_figures(broken: Broken, frames: list[int], views: list[Camera]) -> dict[str, float]:
    """All figures of one object.

    Args:
        broken: The object.
        frames: Those in which pictures are judged.
        views: Cameras of the pictures.
    """
    found: dict[str, float] = {}
    every = broken.broken_frames()
    spacing = broken.matter.spacing[0]
    away, holes, pops = [], [], []
    around = _around(broken)
    history = Repair("chunks").begin(broken.carry)
    cracks: Cracks | None = None
    splits = 0
    for index in range(every[0] - 1, every[-1] + 1):
        moment = broken.moment(index)
        before = history.state()
        cracks = history.step(moment.points())
        assert cracks is not None
        saved = history.partition()
        assert saved is not None
        new = saved.splits[splits:]
        if index >= every[0] and len(pops) < _POPS and any(_parts(s.rank) for s in new):
            pops.append(_pop(broken, before, index - 1, views))
        splits = len(saved.splits)
        if splits:
            away.append((_drawn_points(broken, cracks) - moment.position).norm(dim=1) / spacing)
        if index in frames:
            splats = drawn(broken, history, cracks, moment.points()).gaussians
            shown = cracks.points.position
            holes += [_holes(splats, shown, broken, camera) for camera in [*around, views[-1]]]
    assert cracks is not None
    if not splits:
        return found
    off = torch.cat(away).double().numpy()
    found["points, median"] = float(np.median(off))
    found["points, 90 %"] = float(np.quantile(off, 0.9))
    found["holes, worst %"] = 100.0 * max(holes)
    if pops:
        first, later, whole, wide = (max(values) for values in zip(*pops, strict=True))
        found["pop, mean x 255"] = 255.0 * first
        found["later, mean x 255"] = 255.0 * later
        found["in all, mean x 255"] = 255.0 * whole
        found["open before, h"] = wide
    saved = history.partition()
    assert saved is not None
    partition, volumes = replayed(broken, saved)
    found |= volumes
    return found | _overlap(broken, partition, cracks)


def _parts(rank: Tensor) -> bool:
    """Whether a split makes pieces, not only chips."""
    return int((torch.bincount(rank) >= _PIECE).sum()) > 1


def _around(broken: Broken) -> list[Camera]:
    """Twelve cameras around the matter, as far off as those of a film."""
    positions = [broken.moment(k).position for k in (0, *broken.broken_frames())]
    one = cameras_around(Action.of(positions))[0]
    eye = one.viewmat[:3, :3].T @ -one.viewmat[:3, 3]
    # they look at the same place from the same distance
    forward = one.viewmat[2, :3]
    middle = positions[len(positions) // 2].mean(0).to(eye)
    distance = float((middle - eye) @ forward)
    target = eye + distance * forward
    return [look_at(target, distance, a, e, (one.width, one.height)) for a, e in AROUND]


def _holes(splats: Gaussians, shown: Tensor, broken: Broken, camera: Camera) -> float:
    """Share of what ought to be opaque that is not, where matter is drawn."""
    view = MatterView.of(shown, broken.matter.particles.volume, camera)
    seen = draw(splats, camera, near=0.01, depth=True, background=torch.ones(3))
    return Holes.of(seen.alpha, cast(Tensor, seen.depth), view).fraction


def _drawn_points(broken: Broken, cracks: Cracks) -> Tensor:
    """Where the rest places of the material points are drawn [m], [P, 3]."""
    rest = broken.matter.rest
    return cracks.carry.place(rest, torch.arange(len(rest)), cracks.points)[0]


def _pop(
    broken: Broken, state: dict[str, Any], index: int, views: list[Camera]
) -> tuple[float, float, float, float]:
    """Changes of the picture when the next frame's pieces are known and nothing has moved.

    Args:
        broken: The object.
        state: Of the cracks after frame ``index``.
        index: Frame in whose places everything stays.
        views: Cameras.

    Returns:
        Mean of the absolute change over the matter: of the first picture after the split, of the
        one of the next that changes most, and of all of them together; and how far the points on
        both sides of the new faces have parted already [spacings], 90 % of them.
    """
    here, unit = broken.moment(index), broken.moment(index + 1).unit
    history = Repair("chunks").begin(broken.carry)
    pictures = []
    for known in (here.unit, *[unit] * (FRAMES + 1)):
        if len(pictures) < 2:
            history.restore(state)
        points = here.points(known)
        splats = drawn(broken, history, history.step(points), points).gaussians
        pictures.append([draw(splats, camera, background=torch.ones(3)) for camera in views])
    changes = [_change(*pair) for pair in itertools.pairwise(pictures)]
    near = broken.carry.links.near
    rest, now, h = broken.matter.rest, here.position, broken.matter.spacing[0]
    row, column = (
        ((unit[near] != unit[:, None]) & (here.unit[near] == here.unit[:, None]))
        .nonzero()
        .unbind(1)
    )
    pair = row, near[row, column]
    gap = (now[pair[0]] - now[pair[1]]).norm(dim=1) - (rest[pair[0]] - rest[pair[1]]).norm(dim=1)
    wide = float(torch.quantile(gap[:100_000], 0.9)) / h
    return changes[0], max(changes[1:]), _change(pictures[0], pictures[-1]), wide


def _change(before: list[Rendered], after: list[Rendered]) -> float:
    """Mean of the absolute change of pictures over the matter."""
    changes = [
        (a.image - b.image).abs().mean(-1)[a.alpha > 0.5]
        for a, b in zip(before, after, strict=True)
    ]
    return float(torch.cat(changes).mean())


def replayed(broken: Broken, saved: SavedPartition) -> tuple[Partition, dict[str, float]]:
    """The splits of a run made once more, and what each does to the volumes.

    Voxels are counted here, before and after.
    """
    body, rest = saved.bodies[0], saved.rest
    partition = Partition(
        broken.solid, body.frame, rest, body.spacing, body.number, body.amplitude
    )  # fmt: skip
    inside = partition.depth > 0.0
    number, lost, worst, chips = saved.regions, 0, 0.0, 0.0
    seconds = []
    for split in saved.splits:
        pieces = int(split.rank.max()) + 1
        ids = [split.region, *range(number, number + pieces - 1)]
        number += pieces - 1
        before = int((inside & (partition.region == split.region)).sum())
        began = time.process_time()
        partition.split(split.region, rest[split.rows], split.rank, ids)
        seconds.append(time.process_time() - began)
        after = [int((inside & (partition.region == i)).sum()) for i in ids]
        lost += abs(sum(after) - before)
        many = torch.bincount(split.rank, minlength=pieces).double()
        wanted = (many / many.sum() * before).tolist()
        for points, got, want in zip(many.tolist(), after, wanted, strict=True):
            if points >= _PIECE:
                worst = max(worst, abs(got / want - 1.0))
            else:
                chips = max(chips, abs(got - want) / partition.per_spacing**3)
    found = {
        "voxels lost": float(lost),
        "volume of a piece, worst %": 100.0 * worst,
        "volume of a chip, worst points": chips,
        "splits": float(len(saved.splits)),
        "seconds of a split, longest": max(seconds),
        "voxels": float(partition.region.numel()),
    }
    return partition, found


def _overlap(broken: Broken, partition: Partition, cracks: Cracks) -> dict[str, float]:
    """Share of the drawn matter that lies in that of another piece, or below the floor.

    Every other voxel is carried as it is drawn. Whether it lies in another piece is seen by taking
    it back to rest with the map of the nearest voxel of that piece.
    """
    from scipy.spatial import cKDTree

    voxel = ((partition.depth > 0.0) & (partition.region >= 0)).nonzero()
    region = partition.region[voxel.unbind(dim=1)].long()
    places = partition.center(voxel).float()
    chunk, rest = cracks.points.fragments.long(), broken.matter.rest
    owner = torch.zeros_like(region)
    for number in region.unique().tolist():
        mine, its = (region == number).nonzero()[:, 0], (chunk == number).nonzero()[:, 0]
        its = its if len(its) else torch.arange(len(rest))
        near = cKDTree(rest[its].numpy()).query(places[mine].numpy())[1]
        owner[mine] = its[torch.from_numpy(near)]
    now, local = cracks.carry.place(places, owner, cracks.points)
    some = (voxel % 2 == 0).all(dim=1).nonzero()[:, 0]
    near = torch.from_numpy(cKDTree(now.numpy()).query(now[some].numpy(), k=_NEAR)[1])
    other = region[near] != region[some, None]
    # the first of another piece
    column = other.int().argmax(dim=1)
    beside = near[torch.arange(len(some)), column]
    back = torch.linalg.solve(local[beside].double(), (now[some] - now[beside]).double())
    there = partition.at(places[beside].double() + back)
    overlap = other.any(dim=1) & (there == region[beside])
    deep = now[:, 2] < -broken.matter.spacing[0]
    return {
        "overlap %": 100.0 * float(overlap.float().mean()),
        "below the floor, worst h": float((-now[:, 2]).clamp(min=0).amax())
        / broken.matter.spacing[0],
        "deeper than dx/2 %": 100.0 * float(deep.float().mean()),
    }


def flat_cuts(cells: int = 35, rough: float = 0.25) -> dict[str, float]:
    """Flat cuts through a cube: heights of the faces, and the time of a split.

    Args:
        cells: Point spacings along the cube: 35 have 1.6 million voxels with the rim.
        rough: Rms height asked for [spacings].
    """
    solid, spacing = _cube(cells)
    rest = sample_points(solid, spacing).float()
    steps, heights = [], []
    seconds = [0.0]
    for axis in range(3):
        rank = (rest[:, axis] / spacing / cells + 0.5).mul(_SLABS).long().clamp(0, _SLABS - 1)
        faces = []
        for amplitude in (0.0, rough):
            partition = Partition(solid, Frame.identity(), rest, spacing, 0, amplitude)
            _ = partition.depth
            began = time.process_time()
            split = partition.split(0, rest, rank, list(range(_SLABS)))
            seconds.append(time.process_time() - began)
            faces.append([_height(split, face, axis) for face in range(_SLABS - 1)])
        for smooth, bumpy in zip(*faces, strict=True):
            heights.append(bumpy - smooth)
    for lag in range(2, 13):
        parts = [h.roll(-lag, d)[:-lag, :-lag] - h[:-lag, :-lag] for h in heights for d in (0, 1)]
        steps.append(
            (lag, float(torch.cat([p.reshape(-1) for p in parts]).square().nanmean().sqrt()))
        )
    x, y = np.log(np.array(steps)).T
    every = torch.cat([h.reshape(-1) for h in heights])
    every = every[~every.isnan()]
    # two pieces, one cut: what a fall makes
    two = Partition(solid, Frame.identity(), rest, spacing, 0, rough)
    _ = two.depth
    began = time.process_time()
    two.split(0, rest, (rest[:, 0] > 0.0).long(), [0, 1])
    return {
        "slope": float(np.polyfit(x, y, 1)[0]),
        "rms over the material's": float(every.square().mean().sqrt()) / (3.0 * rough),
        "voxels": float(two.region.numel()),
        "seconds, 2 pieces": time.process_time() - began,
        f"seconds, {_SLABS} pieces": max(seconds),
    }


def _height(split: Any, face: int, axis: int) -> Tensor:
    """Where a face between two labels crosses the columns along an axis [voxels]; nan elsewhere."""
    label = split.labels.first.long().movedim(axis, -1)
    far = split.face.double().movedim(axis, -1)
    low, high = label[..., :-1] == face, label[..., 1:] == face + 1
    crossed = low & high
    row = torch.arange(low.shape[-1], dtype=torch.float64)
    at = row + far[..., :-1] / (far[..., :-1] + far[..., 1:]).clamp(min=1e-12)
    once = crossed.sum(-1) == 1
    return torch.where(once, torch.where(crossed, at, 0.0).sum(-1), torch.nan)[9:-9, 9:-9]


def _cube(cells: int) -> tuple[Solid, float]:
    size, rim = 2 * cells, 2
    spacing = 2.0 / size  # two voxels of the solid
    occupancy = torch.zeros((size + 2 * rim,) * 3, dtype=torch.bool)
    occupancy[rim:-rim, rim:-rim, rim:-rim] = True
    voxel = 1.0 / size
    axis = (torch.arange(size + 2 * rim) + 0.5 - 0.5 * (size + 2 * rim)).abs() * voxel
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    depth = (0.5 - torch.maximum(torch.maximum(x, y), z)).clamp(min=0.0)
    splats = Gaussians.from_colors(
        torch.zeros(1, 3), torch.full((1,), voxel), torch.ones(1, 3), label=INTERIOR
    )
    origin = torch.full((3,), -0.5 * (size + 2 * rim) * voxel)
    return Solid(splats, occupancy, depth, origin, voxel), spacing


BARS = {
    "points, median": ("points against their drawn chunk, median [h]", "0.5"),
    "points, 90 %": ("the same, 90 % [h]", "1.5"),
    "holes, worst %": ("holes, twelve cameras around and one above, worst [%]", "0.2"),
    "pop, mean x 255": ("change at a split, motion frozen, worst [1/255]", "1"),
    "later, mean x 255": ("the same, of a picture of the frames after it [1/255]", "1"),
    "in all, mean x 255": ("what comes over these frames in all [1/255]", ""),
    "open before, h": ("how wide such a crack was before, worst [h]", ""),
    "voxels lost": ("sum of the volumes, voxels lost", "0"),
    "volume of a piece, worst %": ("volume of a piece, worst [%]", "1"),
    "volume of a chip, worst points": ("volume of a chip, worst [points]", ""),
    "overlap %": ("overlap of pieces [%]", "0.3"),
    "deeper than dx/2 %": ("deeper than dx/2 in the floor [%]", "0"),
    "splits": ("splits", ""),
    "voxels": ("voxels", ""),
    "seconds of a split, longest": ("longest split [s of one core]", "1 at 1.6 M"),
}


def chunk_table(found: dict[str, dict[str, float]]) -> Iterator[str]:
    """One column for each object."""
    yield f"| figure | bar | {' | '.join(found)} |"
    yield "| --- " * (len(found) + 2) + "|"
    for key, (title, bar) in BARS.items():
        cells = [_cell(figures[key]) if key in figures else "-" for figures in found.values()]
        yield f"| {title} | {bar} | {' | '.join(cells)} |"


def cut_table(found: dict[str, float]) -> Iterator[str]:
    """Figures of :func:`flat_cuts`."""
    bars = {"slope": "0.8 +- 0.1", "rms over the material's": "1 +- 0.1", "seconds, 2 pieces": "1"}
    yield "| figure | bar | measured |"
    yield "| --- " * 3 + "|"
    for key, value in found.items():
        yield f"| {key} | {bars.get(key, '')} | {_cell(value)} |"


def _cell(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 or value == int(value) else f"{value:.3g}"
