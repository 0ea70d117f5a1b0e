"""What a splat hangs on, and how that moves: points of a solid, points of a surface, triangles.

A splat at ``p`` goes to ``sum_k w_k (x_k + A_k (p - X_k))`` and is turned and stretched by
``A = sum_k w_k A_k``; X_k and x_k are its carriers at rest and now, A_k how the matter around a
carrier is deformed.

Of points, A_k is the affine map that fits the offsets of the neighbours best (moving least squares:
Schaefer, McPhail and Warren 2006; of a deformation gradient: Mueller et al. 2004). Where the
neighbours lie in a plane it says nothing across it. There, and on meshes, the normal is taken to
the normal, stretched by the root of the ratio of areas, as in Sumner and Popovic 2004: a surface
does not know how thick it is, and so a change of size is carried exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.spatial.neighbours import nearest_rows

NEIGHBOURS = 16
"""Points that the deformation around a point is seen from."""
FOLLOWED = 8
"""Points that a splat follows."""
FLAT = 0.02
"""Least over middle variance of the neighbours' offsets below which they lie in a plane."""
TORN = 2.0
"""Stretch between neighbours from which they have parted."""


class Moved(NamedTuple):
    """Where splats have gone.

    Attributes:
        means: [M, 3].
        map: How small vectors there have changed, [M, 3, 3].
        gone: Splats whose carriers are not there, bool [M].
        torn: Splats whose carriers have parted from each other, bool [M].
    """

    means: Tensor
    map: Tensor
    gone: Tensor
    torn: Tensor


@dataclass(frozen=True, eq=False)
class Binding:
    """Splats bound to carriers.

    Attributes:
        rest: Carriers at rest, float64 [N, 3].
        near: Neighbours of each carrier, int64 [N, K].
        faces: Triangles, int64 [F, 3]; None for points.
        index: Carriers of each splat, int64 [M, L].
        weight: Their weights, [M, L], 1 together.
        arm: From them to the splat at rest, [M, L, 3].
        reach: Distance to the nearest carrier over the mean distance of neighbours, [M].
        spacing: Mean distance of neighbouring carriers.
    """

    rest: Tensor
    near: Tensor
    faces: Tensor | None
    index: Tensor
    weight: Tensor
    arm: Tensor
    reach: Tensor
    spacing: float

    def move(self, now: Tensor) -> Moved:
        """Where the splats are when the carriers are at ``now`` [N, 3]; NaN for none."""
        there = torch.isfinite(now).all(dim=1)
        now = torch.where(there[:, None], now, self.rest)
        local, torn = self._local(now, there)
        weight = self.weight * there[self.index]
        total = weight.sum(dim=1)
        gone = total <= 0.0
        weight = weight / total.clamp(min=1e-30)[:, None]
        maps = local[self.index]
        means = now[self.index] + (maps @ self.arm[..., None])[..., 0]
        means = (weight[..., None] * means).sum(dim=1)
        blend = (weight[..., None, None] * maps).sum(dim=1)
        return Moved(means, blend, gone, (weight * torn[self.index]).sum(dim=1) > 0.5)

    def _local(self, now: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
        """Deformation around each carrier [N, 3, 3], and whether its neighbours have left it."""
        if self.faces is not None:
            return _of_triangles(self.rest, now, self.faces, there)
        if self.near.shape[1] == 0:
            return torch.eye(3).to(now).expand(now.shape[0], 3, 3), ~there
        before = self.rest[self.near] - self.rest[:, None]
        after = now[self.near] - now[:, None]
        square = before.square().sum(dim=2)
        far = square.amax(dim=1, keepdim=True).clamp(min=1e-300)
        weight = torch.exp(-2.0 * square / far) * there[self.near]
        long = after.square().sum(dim=2) > TORN**2 * square
        torn = (weight * long).sum(dim=1) > 0.5 * weight.sum(dim=1)
        weight = weight * ~long  # who has left says nothing of who stayed
        # about the mean of the neighbours, not the point itself: its own noise is no deformation
        total = weight.sum(dim=1).clamp(min=1e-30)[:, None, None]
        before = before - (weight[..., None] * before).sum(dim=1, keepdim=True) / total
        after = after - (weight[..., None] * after).sum(dim=1, keepdim=True) / total
        spread = torch.einsum("nk,nki,nkj->nij", weight, before, before)
        cross = torch.einsum("nk,nki,nkj->nij", weight, after, before)
        size, axes = torch.linalg.eigh(spread)  # ascending
        flat = size[:, 0] < FLAT * size[:, 1]
        lost = size[:, 1] <= 1e-9 * far[:, 0]  # a line, or nobody: no deformation can be seen
        inverse = torch.where(
            torch.arange(3, device=now.device) < flat[:, None].long(), 0.0,
            1.0 / size.clamp(min=1e-300),
        )  # fmt: skip
        found = cross @ axes @ torch.diag_embed(inverse) @ axes.transpose(1, 2)
        # across the plane of the neighbours
        u, v, n = axes[:, :, 2], axes[:, :, 1], axes[:, :, 0]
        n = n * torch.sign((torch.linalg.cross(u, v) * n).sum(dim=1, keepdim=True))
        normal = torch.linalg.cross((found @ u[..., None])[..., 0], (found @ v[..., None])[..., 0])
        normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-300).sqrt()
        found = found + flat[:, None, None] * normal[:, :, None] * n[:, None, :]
        return torch.where(lost[:, None, None], torch.eye(3).to(found), found), torn


def bind(places: Tensor, rest: Tensor, faces: Tensor | None = None) -> Binding:
    """Bind places to carriers.

    Args:
        places: Centres of splats, [M, 3].
        rest: Carriers at rest, [N, 3], at least one; all finite.
        faces: Triangles between them, int64 [F, 3]; None for points.
    """
    rest, places = rest.double(), places.double()
    if faces is not None:
        return _bind_mesh(places, rest, faces)
    count = rest.shape[0]
    cell = _cell(rest)
    distance, near = nearest_rows(rest, rest, min(NEIGHBOURS + 1, count), cell)
    near, distance = near[:, 1:], distance[:, 1:]
    spacing = float(distance[:, : min(6, count - 1)].mean()) if count > 1 else 0.0
    away, index = nearest_rows(rest, places, min(FOLLOWED, count), cell)
    # smooth, and nothing at the last one, so that no splat jumps where its neighbours change
    width = away[:, -1:].clamp(min=1e-300)
    weight = (1.0 - (away / width).square()).clamp(min=0.0).square() + 1e-12
    return Binding(
        rest=rest,
        near=near,
        faces=None,
        index=index,
        weight=weight / weight.sum(dim=1, keepdim=True),
        arm=places[:, None] - rest[index],
        reach=away[:, 0] / (spacing or torch.inf),
        spacing=spacing,
    )


def _cell(points: Tensor) -> float:
    """A cell of the search that holds a few points, whether they fill space or a surface."""
    extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
    return max(extent, 1e-12) / max(2.0, points.shape[0] ** 0.4)


def _bind_mesh(places: Tensor, rest: Tensor, faces: Tensor) -> Binding:
    """Bind places to the nearest place of a triangle near them."""
    corners = rest[faces]
    edges = (corners - corners.roll(1, dims=1)).norm(dim=2)
    spacing = float(edges.mean())
    row, bary = _nearest_on_mesh(places, corners, spacing)
    index = faces[row]
    foot = (bary[..., None] * rest[index]).sum(dim=1)
    return Binding(
        rest=rest,
        near=faces.new_zeros(0, 0),
        faces=faces,
        index=index,
        weight=bary,
        arm=places[:, None] - rest[index],
        reach=(places - foot).norm(dim=1) / (spacing or torch.inf),
        spacing=spacing,
    )


def _nearest_on_mesh(places: Tensor, corners: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Nearest triangle of each place, int64 [M], and the place on it, barycentric [M, 3].

    Triangles are sampled as finely as they are far from each other; of those with the nearest
    samples the distances are exact.
    """
    edges = (corners - corners.roll(1, dims=1)).norm(dim=2).amax(dim=1)
    parts = torch.ceil(edges / max(spacing, 1e-300)).clamp(1, 24).long()
    samples, owner = [], []
    for n in torch.unique(parts).tolist():
        rows = (parts == n).nonzero()[:, 0]
        i, j = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
        keep = (i + j) < n
        a, b = (i[keep] + 1 / 3) / n, (j[keep] + 1 / 3) / n
        share = torch.stack([1 - a - b, a, b], dim=1).to(corners)
        samples.append(torch.einsum("sk,fkd->fsd", share, corners[rows]).reshape(-1, 3))
        owner.append(rows.repeat_interleave(share.shape[0]))
    points, whose = torch.cat(samples), torch.cat(owner)
    near = nearest_rows(points, places, min(12, points.shape[0]), _cell(points))[1]
    best = torch.full((places.shape[0],), torch.inf, dtype=torch.float64, device=places.device)
    row, bary = torch.zeros_like(near[:, 0]), places.new_zeros(places.shape[0], 3)
    for k in range(near.shape[1]):
        candidate = whose[near[:, k]]
        share = closest_on_triangle(places, corners[candidate])
        away = (places - (share[..., None] * corners[candidate]).sum(dim=1)).square().sum(dim=1)
        better = away < best
        best = torch.where(better, away, best)
        row = torch.where(better, candidate, row)
        bary = torch.where(better[:, None], share, bary)
    return row, bary


def closest_on_triangle(places: Tensor, triangle: Tensor) -> Tensor:
    """Barycentric coordinates [M, 3] of the nearest place on triangles [M, 3, 3].

    Inside by the normal equations; outside the nearest of the three edges.
    """
    origin = triangle[:, 0]
    first, second = triangle[:, 1] - origin, triangle[:, 2] - origin
    arm = places - origin
    a, b, c = (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)
    d, e = (first * arm).sum(1), (second * arm).sum(1)
    area = (a * c - b * b).clamp(min=1e-300)
    v, w = (c * d - b * e) / area, (a * e - b * d) / area
    found = torch.stack([1 - v - w, v, w], dim=1)
    inside = (found >= 0).all(dim=1)
    best = torch.full_like(v, torch.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = triangle[:, j] - triangle[:, i]
        t = ((places - triangle[:, i]) * along).sum(1) / along.square().sum(1).clamp(min=1e-300)
        t = t.clamp(0.0, 1.0)
        away = (triangle[:, i] + t[:, None] * along - places).square().sum(1)
        share = torch.zeros_like(found)
        share[:, i], share[:, j] = 1 - t, t
        better = ~inside & (away < best)
        best = torch.where(better, away, best)
        found = torch.where(better[:, None], share, found)
    return found


def _of_triangles(rest: Tensor, now: Tensor, faces: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Mean deformation of the triangles around each vertex, by area, [N, 3, 3]."""
    before, area = _frames(rest[faces])
    after, _ = _frames(now[faces])
    whole = there[faces].all(dim=1) & (area > 1e-9 * area.mean())
    maps = after @ torch.linalg.inv(
        torch.where(whole[:, None, None], before, torch.eye(3).to(before))
    )
    maps, share = maps * whole[:, None, None], area * whole
    total = torch.zeros_like(rest[:, 0])
    found = torch.zeros(rest.shape[0], 3, 3).to(rest)
    long = torch.zeros_like(total)
    stretch = (now[faces] - now[faces].roll(1, dims=1)).norm(dim=2)
    stretch = stretch / (rest[faces] - rest[faces].roll(1, dims=1)).norm(dim=2).clamp(min=1e-300)
    parted = (stretch > TORN).any(dim=1).to(total)
    for k in range(3):
        total.index_add_(0, faces[:, k], share)
        found.index_add_(0, faces[:, k], share[:, None, None] * maps)
        long.index_add_(0, faces[:, k], share * parted)
    bare = total <= 0.0
    found = found / total.clamp(min=1e-300)[:, None, None]
    return torch.where(bare[:, None, None], torch.eye(3).to(found), found), long > 0.5 * total


def _frames(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Edges and normal of triangles [F, 3, 3] as columns, and twice their areas [F]."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = torch.linalg.cross(first, second)
    area = normal.norm(dim=1)
    normal = normal / area.clamp(min=1e-300).sqrt()[:, None]
    return torch.stack([first, second, normal], dim=2), area
