"""Faces of cracks: flat splats on the surfaces along which matter has come apart.

At rest every site (:mod:`gsfluent.pipeline.cracks.sites`) belongs to the material point that is
nearest. Where the cells of two points meet that have moved apart there is a face: the plane halfway
between the two. A *face element* is a flat splat on it, one for each site beside it, with the
colour of the matter there and the normal of the plane. All of this is known at rest and computed
once, when the gap opens; from frame to frame the elements are only carried along.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.pipeline.cracks.sites import Sites


class Fit(NamedTuple):
    """How elements fit their face.

    Attributes:
        layer: Half thickness of the layer of sites beside a face, in pitches (times the 1-norm of
            the normal, which makes the layer as thick whatever way the face runs).
        overlap: Pitches by which the middle of an element may lie in the cell of a third point.
        width: Standard deviation along the face, in pitches.
        inset: How far below the face the centre lies, in pitches.
        slack: Standard deviations by which cuts at other faces stay outside of them.
    """

    layer: float
    overlap: float
    width: float
    inset: float
    slack: float


PIECE = Fit(layer=0.85, overlap=0.3, width=0.55, inset=0.3, slack=0.0)
"""On pieces, whose faces are broad: what counts is that nothing shows through."""
DEBRIS = Fit(layer=0.5, overlap=0.0, width=0.4, inset=0.45, slack=-0.8)
"""On debris, which is a few elements wide: what counts is that it does not swell."""
THICKNESS = 0.25
"""Standard deviation across the face, in pitches."""
RIM = 1.5
"""Elements of the skin are made within this many pitches of a face."""
EDGE = 1.5
"""Standard deviations of an element that fit between its centre and the nearest edge."""
CRUST = 0.3
"""Depth to which matter wears the colour of the skin, in voxels: the volume is no finer."""
NARROWEST = 0.3
"""Smallest width of an element that an edge leaves, as a share of its width."""
_STEEP = 0.1  # sine of the angle between two faces below which they have no edge


@dataclasses.dataclass(frozen=True, eq=False)
class Elements:
    """Face elements at rest, sorted by key.

    Args:
        key: What names an element for good: site, rival and kind, int64 [E].
        site: Site of each, int64 [E].
        owner: Point that it belongs to, int64 [E].
        pair: Opening that it shows: owner times K plus the column of the rival, int64 [E].
        means: Centres [m], [E, 3].
        quats: Orientations, the third axis along the normal, [E, 4].
        scales: Standard deviations [m], [E, 3].
        color: RGB in 0..1, [E, 3].
        normals: Unit normals away from the owner's matter, [E, 3].
    """

    key: Tensor
    site: Tensor
    owner: Tensor
    pair: Tensor
    means: Tensor
    quats: Tensor
    scales: Tensor
    color: Tensor
    normals: Tensor

    @functools.cached_property
    def _cells(self) -> tuple[Tensor, Tensor]:
        cell, slot = torch.unique(self.owner, return_inverse=True)
        return cell, slot

    @property
    def cell(self) -> Tensor:
        """Points that own elements, int64 [C]."""
        return self._cells[0]

    @property
    def slot(self) -> Tensor:
        """Place of each element's owner in :attr:`cell`, int64 [E]."""
        return self._cells[1]

    @property
    def count(self) -> int:
        """Number of elements E."""
        return int(self.key.shape[0])

    def select(self, rows: Tensor) -> Elements:
        """The elements picked by a mask or by rows."""
        names = [field.name for field in dataclasses.fields(self)]
        return Elements(*(getattr(self, name)[rows] for name in names))

    @staticmethod
    def sorted(parts: list[Elements]) -> Elements:
        """Join elements, in the order of their keys."""
        names = [field.name for field in dataclasses.fields(Elements)]
        order = torch.cat([part.key for part in parts]).argsort()
        return Elements(
            *(torch.cat([getattr(part, name) for part in parts])[order] for name in names)
        )


def find_elements(
    sites: Sites, rows: Tensor, rest: Tensor, near: Tensor, opened: Tensor, fit: Fit
) -> Elements:
    """Find the face elements of some sites.

    Args:
        sites: All sites.
        rows: The sites asked for, int64 [M].
        rest: Material points at rest [m], [N, 3].
        near: Neighbours of every point, itself first, int64 [N, K].
        opened: Which of them have moved away, bool [N, K].
        fit: :data:`PIECE` or :data:`DEBRIS`.

    Returns:
        Their elements, sorted.
    """
    owner, pitch = sites.owner[rows], sites.pitch[rows]
    index, gone = near[owner], opened[owner]
    middle, points = sites.means[rows], rest[index]
    across = points - rest[owner][:, None]
    width = across.norm(dim=2).clamp(min=1e-12)
    normal = across / width[..., None]
    own = (middle - rest[owner]).square().sum(dim=1, keepdim=True)
    reach = ((points - middle[:, None]).square().sum(dim=2) - own) / (2.0 * width)
    layer = fit.layer * pitch[:, None] * normal.abs().sum(dim=2)
    m, k = (gone & (reach < layer)).nonzero().unbind(dim=1)
    # Where a third point's cell begins the face has ended.
    spot = middle[m] + reach[m, k, None] * normal[m, k]
    third = (points[m] - spot[:, None]).norm(dim=2).amin(dim=1)
    kept = third >= (rest[owner[m]] - spot).norm(dim=1) - fit.overlap * pitch[m]
    m, k = m[kept], k[kept]
    # Its nearest edge: the skin, or another face.
    planes = torch.cat([normal[m], sites.outward[rows[m], None]], dim=1)
    far = torch.where(gone, reach, torch.inf)[m].scatter(1, k[:, None], torch.inf)
    far = torch.cat([far, sites.depth[rows[m], None]], dim=1)
    tilt = (planes * normal[m, k][:, None]).sum(dim=2)
    slope = (1.0 - tilt.square()).clamp(min=0.0).sqrt()
    room = (far - reach[m, k][:, None] * tilt) / slope.clamp(min=_STEEP)
    room, edge = torch.where(slope > _STEEP, room, torch.inf).min(dim=1)
    toward = planes.gather(1, edge[:, None, None].expand(-1, 1, 3))[:, 0]
    crust = sites.depth[rows[m]] < CRUST * sites.voxel[rows[m]]
    color = torch.where(crust[:, None], sites.skin[rows[m]], sites.color[rows[m]])
    faces = _elements(
        sites,
        rows[m],
        near,
        k,
        normal[m, k],
        reach[m, k].clamp(min=0.0),
        toward,
        room,
        color,
        0,
        fit,
    )
    # The skin along the rim of a face: what the splats of the skin leave open.
    outward = sites.outward[rows]
    skin = sites.depth[rows] < fit.layer * pitch * outward.abs().sum(dim=1)
    gap, best = torch.where(gone, reach, torch.inf).min(dim=1)
    m = (skin & (gap < RIM * pitch)).nonzero()[:, 0]
    k = best[m]
    rims = _elements(
        sites, rows[m], near, k, outward[m], sites.depth[rows[m]], normal[m, k],
        gap[m].clamp(min=0.0), sites.skin[rows[m]], 1, fit,
    )  # fmt: skip
    return Elements.sorted([faces, rims])


def _elements(
    sites: Sites,
    site: Tensor,
    near: Tensor,
    column: Tensor,
    normal: Tensor,
    reach: Tensor,
    edge: Tensor,
    room: Tensor,
    color: Tensor,
    kind: int,
    fit: Fit,
) -> Elements:
    """Elements ``reach`` [m] away along ``normal``, narrowed where an edge is near.

    ``room`` [m] is the way to the edge within the face, which lies toward ``edge``.
    """
    pitch, owner = sites.pitch[site], sites.owner[site]
    means = sites.means[site] + (reach - fit.inset * pitch)[:, None] * normal
    # First axis: in the face, toward the edge.
    along = edge - (edge * normal).sum(dim=1, keepdim=True) * normal
    flat = along.norm(dim=1) < _STEEP
    reference = torch.zeros_like(normal).scatter_(1, normal.abs().argmin(1, keepdim=True), 1.0)
    other = torch.linalg.cross(normal, reference)
    first = torch.nn.functional.normalize(torch.where(flat[:, None], other, along), dim=1)
    axes = torch.stack([first, torch.linalg.cross(normal, first), normal], dim=2)
    width = fit.width * pitch
    narrow = torch.minimum(width, torch.maximum(room / EDGE, NARROWEST * width))
    narrow = torch.where(flat, width, narrow)
    return Elements(
        key=(site * near.shape[0] + near[owner, column]) * 2 + kind,
        site=site,
        owner=owner,
        pair=owner * near.shape[1] + column,
        means=means,
        quats=geometry.matrix_to_quaternion(axes),
        scales=torch.stack([narrow, width, THICKNESS * pitch], dim=1),
        color=color,
        normals=normal,
    )
