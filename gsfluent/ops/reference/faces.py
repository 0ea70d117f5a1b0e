"""Face elements one operation at a time (:mod:`gsfluent.ops.faces`)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops.faces import FaceFit, FaceSites


def _planes(rows: Tensor, sites: FaceSites) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which faces there are [M, K], their normals [M, K, 3] and distances [M, K], and points."""
    owner = sites.owner[rows]
    middle, points = sites.means[rows], sites.rest[sites.near[owner]]
    across = points - sites.rest[owner][:, None]
    width = across.norm(dim=2).clamp(min=1e-12)
    own = (middle - sites.rest[owner]).square().sum(dim=1, keepdim=True)
    reach = ((points - middle[:, None]).square().sum(dim=2) - own) / (2.0 * width)
    return sites.opened[owner], across / width[..., None], reach, points


def find_faces(rows: Tensor, sites: FaceSites, fit: FaceFit) -> Tensor:
    """Which places have elements at which faces, and at rims, bool [M, K + 1]."""
    gone, normal, reach, points = _planes(rows, sites)
    pitch = sites.pitch[rows, None]
    inside = gone & (reach < fit.layer * pitch * normal.abs().sum(dim=2))
    spot = sites.means[rows, None] + reach[..., None] * normal
    third = (points[:, None] - spot[:, :, None]).norm(dim=3).amin(dim=2)
    own = (sites.rest[sites.owner[rows]][:, None] - spot).norm(dim=2)
    thick = fit.layer * pitch[:, 0] * sites.outward[rows].abs().sum(dim=1)
    gap = torch.where(gone, reach, torch.inf).amin(dim=1)
    rim = (sites.depth[rows] < thick) & (gap < fit.rim * pitch[:, 0])
    return torch.cat([inside & (third >= own - fit.overlap * pitch), rim[:, None]], dim=1)


def face_elements(
    rows: Tensor, column: Tensor, sites: FaceSites, fit: FaceFit
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Columns, centres, quaternions, standard deviations and normals of elements."""
    gone, planes, reaches, _ = _planes(rows, sites)
    outward, depth, pitch = sites.outward[rows], sites.depth[rows], sites.pitch[rows]
    rim = column == planes.shape[1]
    gap, best = torch.where(gone, reaches, torch.inf).min(dim=1)
    rival = torch.where(rim, best, column)
    each = torch.arange(len(rows))
    plane, signed = planes[each, rival], reaches[each, rival]
    # of a face: the nearest of the others and of the skin
    ends = torch.cat([planes, outward[:, None]], dim=1)
    far = torch.where(gone, reaches, torch.inf).scatter(1, rival[:, None], torch.inf)
    far = torch.cat([far, depth[:, None]], dim=1)
    tilt = (ends * plane[:, None]).sum(dim=2)
    slope = (1.0 - tilt.square()).clamp(min=0.0).sqrt()
    room = (far - signed[:, None] * tilt) / slope.clamp(min=fit.steep)
    room, nearest = torch.where(slope > fit.steep, room, torch.inf).min(dim=1)
    edge = torch.where(rim[:, None], plane, ends[each, nearest])
    room = torch.where(rim, gap.clamp(min=0.0), room)
    normal = torch.where(rim[:, None], outward, plane)
    reach = torch.where(rim, depth, signed.clamp(min=0.0))

    along = edge - (edge * normal).sum(dim=1, keepdim=True) * normal
    flat = along.norm(dim=1) < fit.steep
    axis = torch.zeros_like(normal).scatter_(1, normal.abs().argmin(1, keepdim=True), 1.0)
    other = torch.linalg.cross(normal, axis)
    first = torch.nn.functional.normalize(torch.where(flat[:, None], other, along), dim=1)
    axes = torch.stack([first, torch.linalg.cross(normal, first), normal], dim=2)
    width = fit.width * pitch
    narrow = torch.minimum(width, torch.maximum(room / fit.edge, fit.narrowest * width))
    narrow = torch.where(flat, width, narrow)
    return (
        rival,
        sites.means[rows] + (reach - fit.inset * pitch)[:, None] * normal,
        geometry.matrix_to_quaternion(axes),
        torch.stack([narrow, width, fit.thickness * pitch], dim=1),
        normal,
    )
