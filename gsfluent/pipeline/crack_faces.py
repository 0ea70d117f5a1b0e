"""Faces of cracks: flat splats on the surfaces along which matter comes apart.

At rest every site (:mod:`gsfluent.pipeline.crack_sites`) belongs to a material point, its anchor:
the nearest unbroken one within reach, as in :mod:`gsfluent.pipeline.carry`, or the nearest one in
matter that is crushed. Where the cells of two points meet there may be a face: the plane halfway
between the two. A *face element* is a flat splat on it, one for each site beside it, with the
colour of the matter there and the normal of the plane. All that is known at rest and computed once,
when the points around break; from frame to frame an element only rides with its anchor, and shows
as far as its rival, the point on the other side, has moved away::

    opening = |x_a + A_a (m - X_a) - x_r - A_r (m - X_r)|
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.pipeline.carry import REACH
from gsfluent.pipeline.crack_sites import Sites

LAYER, CRUMB_LAYER = 0.85, 0.7
"""Half thickness of the layer of sites beside the face of a piece and of a crumb, in pitches (times
the 1-norm of the normal, which makes the layer one site thick whatever way the face runs)."""
WIDTH, THICKNESS = 0.55, 0.25
"""Standard deviations of an element along and across its face, in pitches."""
INSET = 0.3
"""How far below the face elements lie, in pitches."""
RIM = 1.5
"""Elements of the skin are made within this many pitches of a face."""
EDGE = 1.5
"""Standard deviations of an element that fit between its centre and the nearest edge."""
CRUST = 0.3
"""Depth to which matter wears the colour of the skin, in voxels: the volume is no finer."""
NARROWEST = 0.3
"""Smallest width of an element that an edge leaves, as a share of :data:`WIDTH`."""
OVERLAP, CRUMB_OVERLAP = 0.3, 0.1
"""Pitches by which the middle of an element may lie in the cell of a third point."""
_FACE, _SKIN = 0, 1
_STEEP = 0.1  # sine of the angle between two faces below which they have no edge


@dataclasses.dataclass(frozen=True, eq=False)
class Elements:
    """Face elements at rest, sorted by key.

    Args:
        key: What names an element for good: site, rival and kind, int64 [E].
        site: Site of each, int64 [E].
        anchor: Point that it rides on, int64 [E].
        rival: Point on the other side of the face, int64 [E].
        means: Centres [m], [E, 3].
        quats: Orientations, the third axis along the normal, [E, 4].
        scales: Standard deviations [m], [E, 3].
        color: RGB in 0..1, [E, 3].
        normals: Unit normals away from the anchor's matter, [E, 3].
        pitch: Pitch of the site [m], [E].
    """

    key: Tensor
    site: Tensor
    anchor: Tensor
    rival: Tensor
    means: Tensor
    quats: Tensor
    scales: Tensor
    color: Tensor
    normals: Tensor
    pitch: Tensor

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
    sites: Sites, rows: Tensor, rest: Tensor, broken: Tensor, loose: Tensor
) -> Elements:
    """Find the face elements of some sites.

    Args:
        sites: All sites.
        rows: The sites asked for, int64 [M].
        rest: Material points at rest [m], [N, 3].
        broken: Broken points, bool [N].
        loose: Points that may part from their neighbours, bool [N]; others have no faces.

    Returns:
        Their elements, unsorted.
    """
    index, distance = sites.index[rows], sites.distance[rows]
    spacing, pitch = sites.spacing[rows, None], sites.pitch[rows]
    middle, points = sites.means[rows, None], rest[index]
    whole = ~broken[index] & (distance <= REACH * spacing)
    riding = whole.any(dim=1, keepdim=True)
    slot = torch.where(riding, whole.to(torch.int8).argmax(dim=1, keepdim=True), 0)
    own = distance.gather(1, slot)
    across = points - points.gather(1, slot[..., None].expand(-1, 1, 3))
    width = across.norm(dim=2)
    # Cells of like points meet halfway; whole points hold what is within their reach.
    like = whole == riding
    halfway = (distance.square() - own.square()) / (2.0 * width.clamp(min=1e-12))
    edge = torch.where(riding, REACH * spacing - own, distance - REACH * spacing)
    out = torch.where(riding[..., None], across - (points - middle), points - middle)
    away = torch.where(like[..., None], across, out)
    normal = torch.nn.functional.normalize(away, dim=2)
    reach = torch.where(like, halfway, edge)
    may_part = loose[index] | loose[index.gather(1, slot)]
    real = may_part & torch.isfinite(distance) & (width > 0.0)
    # Behind the reach of a whole point the broken one that lies straight ahead stands for all.
    ahead = torch.where(like | ~real, -torch.inf, (across * normal).sum(dim=2))
    first = torch.zeros_like(real).scatter_(1, ahead.argmax(dim=1, keepdim=True), True)
    real &= like | ~riding | first
    layer = torch.where(riding, LAYER, CRUMB_LAYER) * pitch[:, None]
    near = reach < layer * normal.abs().sum(dim=2)
    pair = (real & near).nonzero()
    m, k = pair.unbind(dim=1)
    # A third point's cell may cover the face here.
    spot = middle[m, 0] + reach[m, k, None] * normal[m, k]
    others = (points[m] - spot[:, None]).norm(dim=2)
    others = torch.where(like[m], others, torch.inf).amin(dim=1)
    overlap = torch.where(riding[m, 0], OVERLAP, CRUMB_OVERLAP) * pitch[m]
    mine = others >= (points[m, slot[m, 0]] - spot).norm(dim=1) - overlap
    mine |= ~like[m, k]
    m, k = m[mine], k[mine]
    anchor = index.gather(1, slot)[:, 0]
    # The nearest edge of the face: the skin, or another face of a crumb. The faces of a piece go on
    # where the cell of its next point begins.
    planes = torch.cat([normal[m], sites.outward[rows[m], None]], dim=1)
    far = torch.where(real & ~riding, reach, torch.inf)[m].scatter(1, k[:, None], torch.inf)
    far = torch.cat([far, sites.depth[rows[m], None]], dim=1)
    tilt = (planes * normal[m, k][:, None]).sum(dim=2)
    slope = (1.0 - tilt.square()).clamp(min=0.0).sqrt()
    room = (far - reach[m, k][:, None] * tilt) / slope.clamp(min=_STEEP)
    room, edge_of = torch.where(slope > _STEEP, room, torch.inf).min(dim=1)
    toward = planes.gather(1, edge_of[:, None, None].expand(-1, 1, 3))[:, 0]
    color = torch.where(
        (sites.depth[rows[m]] < CRUST * sites.voxel[rows[m]])[:, None],
        sites.skin[rows[m]], sites.color[rows[m]],
    )  # fmt: skip
    faces = _elements(
        sites, rows[m], anchor[m], index[m, k], normal[m, k], reach[m, k].clamp(min=0.0),
        toward, room, color, _FACE, rest.shape[0],
    )  # fmt: skip
    # The skin along the rim of a face: what the splats of the skin leave open.
    outward = sites.outward[rows]
    skin = sites.depth[rows] < layer[:, 0] * outward.abs().sum(dim=1)
    close = torch.where(real, reach, torch.inf)
    best = close.argmin(dim=1)
    gap = close.gather(1, best[:, None])[:, 0]
    m = (skin & (gap < RIM * pitch)).nonzero()[:, 0]
    rims = _elements(
        sites, rows[m], anchor[m], index[m, best[m]], outward[m], sites.depth[rows[m]],
        normal[m, best[m]], gap[m].clamp(min=0.0), sites.skin[rows[m]], _SKIN, rest.shape[0],
    )  # fmt: skip
    return Elements.sorted([faces, rims])


def _elements(
    sites: Sites,
    site: Tensor,
    anchor: Tensor,
    rival: Tensor,
    normal: Tensor,
    reach: Tensor,
    edge: Tensor,
    room: Tensor,
    color: Tensor,
    kind: int,
    points: int,
) -> Elements:
    """Elements ``reach`` [m] away along ``normal``, narrowed where an edge is near.

    ``room`` [m] is the way to the edge within the face, which lies toward ``edge``.
    """
    pitch = sites.pitch[site]
    means = sites.means[site] + (reach - INSET * pitch)[:, None] * normal
    # First axis: in the face, toward the edge.
    along = edge - (edge * normal).sum(dim=1, keepdim=True) * normal
    flat = along.norm(dim=1) < _STEEP
    reference = torch.zeros_like(normal).scatter_(1, normal.abs().argmin(1, keepdim=True), 1.0)
    other = torch.linalg.cross(normal, reference)
    first = torch.nn.functional.normalize(torch.where(flat[:, None], other, along), dim=1)
    axes = torch.stack([first, torch.linalg.cross(normal, first), normal], dim=2)
    width = WIDTH * pitch
    narrow = torch.minimum(width, torch.maximum(room / EDGE, NARROWEST * width))
    narrow = torch.where(flat, width, narrow)
    return Elements(
        key=(site * points + rival) * 2 + kind,
        site=site,
        anchor=anchor,
        rival=rival,
        means=means,
        quats=geometry.matrix_to_quaternion(axes),
        scales=torch.stack([narrow, width, THICKNESS * pitch], dim=1),
        color=color,
        normals=normal,
        pitch=pitch,
    )
