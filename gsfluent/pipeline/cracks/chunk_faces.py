"""Faces and cuts of chunks: what a split of the rest solid leaves on its two sides.

All of it is at rest and made once, when a region is split
(:mod:`gsfluent.pipeline.partition.tree`); from frame to frame it is only carried along.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Gaussians, Solid
from gsfluent.ops.reference.deform import CUT_REACH
from gsfluent.pipeline.cracks.sites import matter_colors, skin_colors_at
from gsfluent.pipeline.partition.splits import Split, Splits
from gsfluent.pipeline.partition.tree import Partition
from gsfluent.spatial.neighbours import nearest_in_group

INSET = 0.15
"""How far below its face an element lies, in voxels."""
WIDTH, THICKNESS = 0.75, 0.15
"""Standard deviations of an element along and across its face, in voxels."""
CRUST = 0.5
"""Depth [voxels of the colours] to which an element wears the colour of the skin."""
STEEPEST = 1.0
"""Slope of the walls of pores, at most: where they are steeper one would look past the element."""
_STEP = 1.5  # voxels that an element may be moved onto its face
_LEAST = 1e-12
_NUMBER = 41  # bits of a key below the number of its split


@dataclasses.dataclass(frozen=True, eq=False)
class ChunkFaces:
    """Face elements at rest.

    Args:
        key: What names an element for good, int64 [E].
        voxel: Number of its voxel in its body's grid, int64 [E].
        region: Region that it belongs to, int64 [E].
        beyond: Region across the face when it was made, int64 [E].
        means: Centres [m], [E, 3].
        quats: Orientations, the third axis along the normal, [E, 4].
        scales: Standard deviations [m], [E, 3].
        color: RGB in 0..1, [E, 3].
        normals: Unit normals away from the matter, [E, 3].
        owner: Point that each moves with, int64 [E].
        rival: Point across the face, int64 [E]; the one of dust where it was that.
        ash: Point of the dust that the element's own matter has become, int64 [E]; -1 for none.
    """

    key: Tensor
    voxel: Tensor
    region: Tensor
    beyond: Tensor
    means: Tensor
    quats: Tensor
    scales: Tensor
    color: Tensor
    normals: Tensor
    owner: Tensor
    rival: Tensor
    ash: Tensor

    @property
    def count(self) -> int:
        """Number of elements E."""
        return int(self.key.shape[0])

    def select(self, rows: Tensor) -> ChunkFaces:
        """The elements picked by a mask or by rows."""
        names = [field.name for field in dataclasses.fields(self)]
        return ChunkFaces(*(getattr(self, name)[rows] for name in names))

    @staticmethod
    def joined(parts: list[ChunkFaces]) -> ChunkFaces:
        """All elements of some splits."""
        names = [field.name for field in dataclasses.fields(ChunkFaces)]
        return ChunkFaces(*(torch.cat([getattr(p, name) for p in parts]) for name in names))


class ChunkCuts(NamedTuple):
    """Splats that lie across a face.

    Attributes:
        splat: Row of each, int64 [C].
        beyond: Region across the face when it was made, int64 [C].
        normal: Unit normal of the face, away from the splat's matter, [C, 3].
        distance: Way from the splat's centre to the face along it [m], [C].
        rival: Point across the face, int64 [C].
    """

    splat: Tensor
    beyond: Tensor
    normal: Tensor
    distance: Tensor
    rival: Tensor


def find_faces(
    partition: Partition,
    splits: Splits,
    solid: Solid,
    numbers: Sequence[int],
    relief: float = 0.0,
) -> ChunkFaces:
    """Face elements of splits: one in every voxel beside a voxel of another piece.

    Owner and rival are left to the caller (-1).

    Args:
        partition: Of the body.
        splits: What was done, to regions that none of the others touched.
        solid: The body's solid, for the colours.
        numbers: Number of each split, which enters the keys.
        relief: How much higher white matter stands than black [m]: pores are pits.
    """
    edge, each = partition.voxel, splits.each
    sites = [_beside(partition, split) for split in each]
    grid, other = (torch.cat(part) for part in zip(*sites, strict=True))
    of = torch.arange(len(each), device=grid.device).repeat_interleave(
        torch.tensor([len(site) for site, _ in sites], device=grid.device), output_size=len(grid)
    )
    label, second = splits.labels(of, grid)
    beyond = torch.where((second >= 0) & (second != label), second, other)
    far, gradient = splits.slope(of, label, grid, edge)
    slope = gradient.norm(dim=1).clamp(min=_LEAST)
    normal = -gradient / slope[:, None]
    reach = (far / slope.clamp(min=0.2)).clamp(0.0, _STEP * edge)
    center = partition.center(grid).to(torch.float32)
    below = partition.depth[grid.unbind(dim=1)]
    outward = _outward(partition, grid)
    flat = (grid[:, 0] * partition.shape[1] + grid[:, 1]) * partition.shape[2] + grid[:, 2]
    number = torch.tensor(list(numbers), dtype=torch.int64, device=grid.device)[of]
    matter, skin = _colors(partition, solid, center, below)
    crust = below < min(CRUST * partition.solid_voxel, edge)
    common = {
        "voxel": flat, "region": splits.region(of, label), "beyond": splits.region(of, beyond),
        "number": number,
    }  # fmt: skip
    spot = center + (reach - INSET * edge)[:, None] * normal
    toward = normal
    if relief > 0.0:
        tilted = _tilted(partition, solid, spot, normal, relief)
        toward = torch.where(crust[:, None], normal, tilted)
    parts = [
        _elements(
            spot, toward, edge, torch.where(crust[:, None], skin, matter), 0,
            (outward, below - ((spot - center) * outward).sum(dim=1)), **common,
        )
    ]  # fmt: skip
    # the skin along the rim, which splats cut at the face leave open
    rim = below < 1.2 * edge
    place = center + (below - INSET * edge)[:, None] * outward
    left = reach - ((place - center) * normal).sum(dim=1)
    parts.append(
        _elements(
            place, outward, edge, skin, 1, (normal, left), **common
        ).select(rim & (left > -edge))
    )  # fmt: skip
    made = ChunkFaces.joined(parts)
    return made if len(each) == 1 else made.select(torch.argsort(made.key >> _NUMBER, stable=True))


def _beside(partition: Partition, split: Split) -> tuple[Tensor, Tensor]:
    """Voxels of the body's grid beside one of another piece [M, 3], and the label there [M]."""
    first = split.labels.first
    span = tuple(slice(a, a + n) for a, n in zip(split.low, first.shape, strict=True))
    inside = (first >= 0) & (partition.depth[span] > 0.0)
    face = torch.zeros_like(inside)
    other = torch.full_like(first, -1)
    for axis in range(3):
        n = first.shape[axis]
        a, b = first.narrow(axis, 0, n - 1), first.narrow(axis, 1, n - 1)
        both = inside.narrow(axis, 0, n - 1) & inside.narrow(axis, 1, n - 1) & (a != b)
        face.narrow(axis, 0, n - 1).logical_or_(both)
        face.narrow(axis, 1, n - 1).logical_or_(both)
        for start, theirs in ((0, b), (1, a)):
            part = other.narrow(axis, start, n - 1)
            part.copy_(torch.where(both, theirs, part))
    voxel = face.nonzero()
    low = torch.tensor(split.low, device=voxel.device)
    return voxel + low, other[voxel.unbind(dim=1)].long()


def _elements(
    means: Tensor, normal: Tensor, edge: float, color: Tensor, kind: int,
    plane: tuple[Tensor, Tensor], *, number: Tensor, voxel: Tensor, region: Tensor, beyond: Tensor,
) -> ChunkFaces:  # fmt: skip
    """Flat elements that end at a plane: its unit normal, and how far off it is [m]."""
    axes = torch.stack([*_across(normal), normal], dim=2)
    size = torch.tensor([WIDTH, WIDTH, THICKNESS], device=means.device) * edge
    root = axes * size
    covariance = root @ root.mT
    way, off = plane
    means, quats, scales = ops.cut_by_planes(
        means, geometry.pack_symmetric(covariance), normal=way, distance=off,
        first=torch.arange(len(means) + 1, device=means.device),
    )  # fmt: skip
    none = torch.full_like(voxel, -1)
    return ChunkFaces(
        key=(number << _NUMBER) + (voxel << 1) + kind, voxel=voxel, region=region, beyond=beyond,
        means=means, quats=quats, scales=scales, color=color, normals=normal,
        owner=none, rival=none, ash=none,
    )  # fmt: skip


def _tilted(
    partition: Partition, solid: Solid, spot: Tensor, normal: Tensor, relief: float
) -> Tensor:
    """Normals [M, 3] of faces on which lightness is height: ``relief`` [m] from black to white."""
    one, two = _across(normal)
    slopes = []
    for axis in (one, two):
        ends = []
        for side in (1.0, -1.0):
            means = partition.own(spot + side * partition.voxel * axis).to(torch.float32)
            place = (means - solid.origin.to(means)) / solid.voxel
            ends.append(matter_colors(solid, place, means).mean(dim=1))
        slopes.append((ends[0] - ends[1]) * (0.5 * relief / partition.voxel))
    steep = torch.stack(slopes, dim=1)
    steep = steep * (STEEPEST / steep.norm(dim=1, keepdim=True).clamp(min=1e-6)).clamp(max=1.0)
    return torch.nn.functional.normalize(normal - steep[:, :1] * one - steep[:, 1:] * two, dim=1)


def _across(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors along faces of normals [M, 3]."""
    reference = torch.zeros_like(normal).scatter_(1, normal.abs().argmin(1, keepdim=True), 1.0)
    one = torch.nn.functional.normalize(torch.linalg.cross(normal, reference), dim=1)
    return one, torch.linalg.cross(normal, one)


def _outward(partition: Partition, grid: Tensor) -> Tensor:
    """Unit vectors to the skin at voxels [M, 3]."""
    depth, size = partition.depth, torch.tensor(partition.shape, device=grid.device)
    parts = []
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.int64, device=grid.device)
        step[axis] = 1
        a = torch.minimum(grid + step, size - 1).unbind(dim=1)
        b = (grid - step).clamp(min=0).unbind(dim=1)
        parts.append(depth[a] - depth[b])
    return -torch.nn.functional.normalize(torch.stack(parts, dim=1), dim=1)


def _colors(
    partition: Partition, solid: Solid, center: Tensor, below: Tensor
) -> tuple[Tensor, Tensor]:
    """Colours of the matter at places [m], and of the skin where it is near."""
    means = partition.own(center).to(torch.float32)
    place = (means - solid.origin.to(means)) / solid.voxel
    matter = matter_colors(solid, place, means)
    skin = matter.clone()
    near = (below < 1.5 * max(partition.voxel, CRUST * partition.solid_voxel)).nonzero()[:, 0]
    shown = skin_colors_at(solid, means[near])
    if shown is not None:
        skin[near] = shown.to(skin)
    return matter, skin


def colors_at(partition: Partition, solid: Solid, means: Tensor) -> Tensor:
    """Colours of a body at places at rest [m], [M, 3]: the skin's at the skin, else the inside's.

    Places beside the matter have the colour of the skin nearest to them.
    """
    below = partition.depth_at(means)
    matter, skin = _colors(partition, solid, means, below)
    crust = below < min(CRUST * partition.solid_voxel, partition.voxel)
    return torch.where(crust[:, None], skin, matter).clamp(0.0, 1.0)


def find_cuts(
    partition: Partition, splits: Splits, splats: Gaussians, rows: Tensor, of: Tensor
) -> tuple[Tensor, ChunkCuts]:
    """Which splats are divided by splits.

    Args:
        partition: Of the body.
        splits: What was done, to regions that none of the others touched.
        splats: At rest.
        rows: Those of the regions that were split, int64 [M].
        of: Number of the split of each, int64 [M].

    Returns:
        The region of each row now, int64 [M], and the cuts; rivals are left to the caller (-1).
    """
    edge = partition.voxel
    place = partition.place(splats.means[rows])
    voxel = place.round().long()
    label, second = splits.labels(of, voxel)
    # a splat off the matter goes with the matter beside it
    region = splits.region(of, label.clamp(min=0))
    found = (label >= 0).nonzero()[:, 0]
    of, label, second = of[found], label[found], second[found]
    voxel, place = voxel[found], place[found]
    far, gradient = splits.slope(of, label, voxel, edge)
    far = far + (gradient * ((place - voxel) * edge).to(gradient)).sum(dim=1)
    slope = gradient.norm(dim=1).clamp(min=_LEAST)
    normal = -gradient / slope[:, None]
    distance = far / slope.clamp(min=0.2)
    root = geometry.quaternion_to_matrix(splats.quats[rows[found]])
    root = root * splats.scales[rows[found], None]
    sigma = (normal[:, None] @ root)[:, 0].norm(dim=1)
    cut = (second >= 0) & (distance < CUT_REACH * sigma)
    beyond = splits.region(of[cut], second[cut])
    return region, ChunkCuts(
        rows[found[cut]], beyond, normal[cut], distance[cut], torch.full_like(beyond, -1)
    )


def wide_cuts(
    splats: Gaussians, rows: Tensor, region: Tensor, cuts: ChunkCuts, faces: ChunkFaces, cell: float
) -> ChunkCuts:
    """Add cuts of splats that reach a face from farther than the partition's distance goes.

    A flat patch of skin may be one splat of many points' width. It is cut at the plane through the
    nearest element of its region, across the way there.

    Args:
        splats: At rest.
        rows: Those of the regions that were split, int64 [M].
        region: Region of each now, int64 [M].
        cuts: Those near the faces.
        faces: Elements that the splits made.
        cell: Cell of the search [m].
    """
    known = torch.isin(rows, cuts.splat) | ~torch.isin(region, faces.region)
    reach = CUT_REACH * splats.scales[rows].amax(dim=1) / cell
    octave = torch.where(known, 0.0, torch.log2(reach.clamp(min=1.0)).ceil())
    found = [cuts]
    for number in torch.unique(octave[octave > 0]).tolist():
        some = (octave == number).nonzero()[:, 0]
        mine, means = rows[some], splats.means[rows[some]]
        way, near = nearest_in_group(
            faces.means, faces.region, means, region[some], 1, cell, 2.0**number * cell
        )
        element, distance = near[:, 0].clamp(min=0), way[:, 0].to(means)
        normal = (faces.means[element] - means) / distance.clamp(min=1e-12)[:, None]
        root = geometry.quaternion_to_matrix(splats.quats[mine]) * splats.scales[mine, None]
        across = (distance > 0.0) & (
            distance < CUT_REACH * (normal[:, None] @ root)[:, 0].norm(dim=1)
        )
        beyond = faces.beyond[element]
        parts = (mine, beyond, normal, distance, torch.full_like(beyond, -1))
        found.append(ChunkCuts(*(part[across] for part in parts)))
    return ChunkCuts(*(torch.cat(parts) for parts in zip(*found, strict=True)))
