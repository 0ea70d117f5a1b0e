"""The partition of one body: a tree of splits, each of which touches only the piece that splits.

Regions are numbers on the voxels of the rest solid. A split divides the voxels of one region by the
labels of its points; the largest part keeps the number, the others get new ones. What lies between
older regions never changes, so nothing pops, and a run that replays its splits has the same faces.
"""

from __future__ import annotations

import functools
import logging
import math

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Frame, Solid
from gsfluent.ops.spatial import trilinear
from gsfluent.pipeline.partition.blur import box_width, reach
from gsfluent.pipeline.partition.splits import Split
from gsfluent.pipeline.partition.threshold import (
    CHIP,
    FAR,
    FIRST,
    SECOND,
    STAMP,
    displaced,
    fields,
    join_islands,
    keep_volumes,
    top_two,
)
from gsfluent.spatial.neighbours import nearest_rows
from gsfluent.spatial.pieces import signed_depth

_log = logging.getLogger(__name__)

PER_SPACING = 3.0
"""Voxels per point spacing and axis."""
MOST = {"cpu": 4_000_000, "cuda": 64_000_000}
"""Voxels of a body's box, at most; more would make coarser ones."""
_RIM = 2  # point spacings around the body that have voxels
_LAYERS = 64  # of voxels that have distances in double precision at once


class Partition:
    """The regions of one body.

    Args:
        solid: The filled object.
        frame: From its own coordinates to where it is at time 0.
        rest: Its points there [m], [P, 3].
        spacing: Distance between them [m].
        root: Number of the region that it is at first.
        amplitude: Rms height of its crack faces, in spacings.
        keep: Whether to remember what splits found in their voxels, as meshes need it, or only
            their numbers.

    Attributes:
        voxel: Edge of a voxel [m].
        origin: Centre of voxel (0, 0, 0) [m], float64 [3].
        region: Region of each voxel, -1 for none, int32 [X, Y, Z].
        splits: What was done so far.
    """

    def __init__(
        self, solid: Solid, frame: Frame, rest: Tensor, spacing: float, root: int,
        amplitude: float, *, keep: bool = True,
    ) -> None:  # fmt: skip
        low, high = rest.double().amin(dim=0), rest.double().amax(dim=0)
        low, high = low - _RIM * spacing, high + _RIM * spacing
        device = rest.device
        self.spacing, self.amplitude = spacing, amplitude
        self.voxel = spacing / PER_SPACING
        extent = (high - low).cpu()
        count, most = float((extent / self.voxel).prod()), MOST.get(device.type, MOST["cuda"])
        if count > most:
            coarser = (count / most) ** (1.0 / 3.0)
            self.voxel *= coarser
            _log.info(
                "partition: %.3g voxels are more than %.3g; they are %.2f times as coarse",
                count, most, coarser,
            )  # fmt: skip
        self.origin = low
        self.shape = tuple(int(n) for n in (extent / self.voxel).ceil().long() + 1)
        self.splits: list[Split] = []
        self._rest, self._solid, self._frame, self._keep = rest, solid, frame, keep
        self.region = ops.nearest_labels(
            self.place(rest), torch.zeros(len(rest), dtype=torch.int64, device=device),
            self.shape, self.per_spacing * STAMP,
        ).to(torch.int32)  # fmt: skip
        self.region = torch.where((self.region >= 0) | (self.depth > 0.0), root, -1)
        self._volumes = {root: int((self.depth > 0.0).sum())}

    @property
    def per_spacing(self) -> float:
        """Voxels per point spacing."""
        return self.spacing / self.voxel

    @functools.cached_property
    def depth(self) -> Tensor:
        """Depth below the skin [m], negative outside, [X, Y, Z]."""
        solid, back = self._solid.to(self.region_device), self._frame.inverse()
        field = signed_depth(solid.occupancy, solid.depth / solid.voxel)
        edge = self._frame.scale * solid.voxel
        parts = []
        y, z = (torch.arange(n, device=field.device) for n in self.shape[1:])
        for x in torch.arange(self.shape[0], device=field.device).split(16):
            centers = self.center(torch.cartesian_prod(x, y, z))
            place = (back.apply(centers) - solid.origin.to(centers)) / solid.voxel - 0.5
            # outside of the grid as at its border
            size = torch.tensor(field.shape, device=field.device)
            held = torch.minimum(place.clamp(min=0.0), (size - 1).to(place)).to(torch.float32)
            parts.append(trilinear(field, held) - (place - held).norm(dim=1).to(torch.float32))
        return torch.cat(parts).view(self.shape) * edge

    @property
    def region_device(self) -> torch.device:
        """Where the voxels are."""
        return self._rest.device

    def place(self, points: Tensor) -> Tensor:
        """Places in voxels, centres at whole numbers, float64 [M, 3], of points [m]."""
        return (points.double() - self.origin) / self.voxel

    def own(self, points: Tensor) -> Tensor:
        """Points [m] in the solid's own coordinates, float64 [M, 3]."""
        return self._frame.inverse().apply(points.double())

    @property
    def solid_voxel(self) -> float:
        """Edge of the solid's voxels [m]."""
        return self._frame.scale * self._solid.voxel

    @property
    def solid_volume(self) -> float:
        """Volume of the solid [m^3]."""
        return self._frame.scale**3 * self._solid.volume

    def center(self, voxel: Tensor) -> Tensor:
        """Centres [m] of voxels [M, 3], float64."""
        return voxel.double() * self.voxel + self.origin

    def at(self, points: Tensor) -> Tensor:
        """Region of the voxel around each point [m], int64 [M]; -1 off the matter."""
        voxel = self.place(points).round().long()
        size = torch.tensor(self.shape, device=points.device)
        here = ((voxel >= 0) & (voxel < size)).all(dim=1)
        x, y, z = torch.minimum(voxel.clamp(min=0), size - 1).unbind(dim=1)
        return torch.where(here, self.region[x, y, z].long(), -1)

    def depth_at(self, points: Tensor) -> Tensor:
        """Depth below the skin [m], negative outside, of the voxels around points [m], [M]."""
        size = torch.tensor(self.shape, device=points.device)
        voxel = torch.minimum(self.place(points).round().long().clamp(min=0), size - 1)
        return self.depth[voxel.unbind(dim=1)]

    def volume(self, region: int) -> int:
        """Voxels of a region inside the skin."""
        return self._volumes.get(region, 0)

    def split(
        self, region: int, points: Tensor, piece: Tensor, ids: list[int], dust: int = -1
    ) -> Split:
        """Divide a region by what its points have become.

        Args:
            region: Its number.
            points: Its points that are of a piece, at rest [m], [P, 3].
            piece: Which one, int64 [P]; 0 the largest, and so on
                (:func:`~gsfluent.pipeline.matter.fragments.ranked`).
            ids: Regions by piece, the first one ``region`` itself.
            dust: The piece that is dust, single points; -1 for none.

        Returns:
            What was done.
        """
        place = self.place(points)
        sizes = torch.bincount(piece, minlength=len(ids))
        low, shape = self._span(place, piece)
        span = tuple(slice(a, a + n) for a, n in zip(low, shape, strict=True))
        # from here on in voxels of the box
        local = place - torch.tensor(low, device=place.device)
        radius = self.per_spacing * STAMP
        high = torch.tensor(shape, device=place.device) - 1 + radius
        near = ((local > -radius) & (local < high)).all(dim=1)
        domain = self.region[span] == region
        nearest = ops.nearest_labels(local[near], piece[near].long(), shape, radius)
        lost = (domain & (nearest < 0)).nonzero()
        if len(lost):
            centers = self.center(lost + torch.tensor(low, device=lost.device))
            rows = nearest_rows(points.double(), centers, 1, self.spacing)[1][:, 0]
            nearest[lost[:, 0], lost[:, 1], lost[:, 2]] = piece[rows].to(torch.int16)
        nearest = torch.where(domain, nearest, -1)
        inside = domain & (self.depth[span] > 0.0)
        small = [int(n) < CHIP for n in sizes.tolist()]
        found = fields(nearest, small, self.per_spacing, dust)
        labels = top_two(shape, found, domain)
        voxels, rest = displaced(labels, found, low, self.amplitude * self.per_spacing)
        x, y, z = voxels.unbind(dim=1)
        counted = inside[x, y, z]
        calm = inside.clone()
        calm[x, y, z] = False
        fixed = torch.bincount(labels.first[calm].long(), minlength=len(ids))
        total = self._volumes[region]
        fixed[0] += total - int(inside.sum())
        wanted = sizes.double().cpu() * (total / float(sizes.sum()))
        edge, _ = keep_volumes(rest, counted, fixed, wanted)
        for part, new in zip(labels, edge, strict=True):
            part[x, y, z] = new
        labels = join_islands(labels, voxels, dust)
        volume = torch.bincount(labels.first[inside].long(), minlength=len(ids)).cpu()
        volume[0] += total - int(inside.sum())
        table = torch.tensor(ids, dtype=torch.int32, device=domain.device)
        self.region[span] = torch.where(
            domain, table[labels.first.long().clamp(min=0)], self.region[span]
        )
        self._volumes.update(zip(ids, volume.tolist(), strict=True))
        sigma = SECOND * self.spacing
        # of a flat face: the difference of two blurred halves is an error function
        far = torch.empty_like(labels.lead)
        for lead, part in zip(labels.lead.split(_LAYERS), far.split(_LAYERS), strict=True):
            value = torch.special.erfinv(lead.clamp(0.0, 0.9995).double()) * (2.0**0.5 * sigma)
            part.copy_(value.clamp(max=FAR * sigma))
        error = (volume.double() - wanted) / wanted.clamp(min=1.0)
        done = Split(low, tuple(ids), labels, far, error)
        self.splits.append(done if self._keep else done.numbers())
        return done

    def assign(
        self, owner: Tensor, done: Split, rest: Tensor, rows: Tensor, piece: Tensor
    ) -> Tensor:
        """Regions of points after a split.

        Args:
            owner: Before it, int64 [N].
            done: The split, the last one so far.
            rest: All points at rest [m], [N, 3].
            rows: What was given to :meth:`split`, int64 [P].
            piece: The same, int64 [P].

        Returns:
            int64 [N]. What belongs to no piece goes where it lay.
        """
        table, region = torch.tensor(done.ids, device=owner.device), done.ids[0]
        others = owner == region
        others[rows] = False
        owner = owner.clone()
        owner[rows] = table[piece]
        lone = others.nonzero()[:, 0]
        where = self.at(rest[lone])
        owner[lone] = torch.where(torch.isin(where, table), where, region)
        return owner

    def _span(
        self, place: Tensor, piece: Tensor
    ) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        """First voxel and size of the box that a split touches: around all but the largest part."""
        others = place[piece > 0]
        per = self.per_spacing
        margin = reach(box_width(FIRST * per)) + reach(box_width(SECOND * per))
        margin += math.ceil((STAMP + 4.0 * self.amplitude) * per) + 1
        low = (others.amin(dim=0).floor().long() - margin).clamp(min=0)
        size = torch.tensor(self.shape, device=low.device)
        high = torch.minimum(others.amax(dim=0).ceil().long() + margin + 1, size)
        a, b, c = low.tolist()
        x, y, z = (high - low).tolist()
        return (a, b, c), (x, y, z)
