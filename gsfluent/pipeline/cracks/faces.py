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

from gsfluent.ops.faces import FaceFit, FaceSites, face_elements, find_faces
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
    around = FaceSites(
        sites.means, sites.owner, sites.pitch, sites.outward, sites.depth, near, opened, rest
    )
    fits = FaceFit(
        fit.layer, fit.overlap, fit.width, fit.inset, RIM, EDGE, NARROWEST, _STEEP, THICKNESS
    )
    # elements of the skin along the rim of a face: what the splats of the skin leave open
    m, column = find_faces(rows, around, fits).nonzero().unbind(dim=1)
    site, rim = rows[m], column == near.shape[1]
    rival, means, quats, scales, normals = face_elements(site, column, around, fits)
    owner = sites.owner[site]
    crust = rim | (sites.depth[site] < CRUST * sites.voxel[site])
    made = Elements(
        key=(site * near.shape[0] + near[owner, rival]) * 2 + rim,
        site=site,
        owner=owner,
        pair=owner * near.shape[1] + rival,
        means=means,
        quats=quats,
        scales=scales,
        color=torch.where(crust[:, None], sites.skin[site], sites.color[site]),
        normals=normals,
    )
    return made.select(made.key.argsort())
