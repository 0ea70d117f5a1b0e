"""Closed meshes of the pieces of a partition: multi-label dual contouring.

Every cell of eight voxel centres that holds more than one label has one vertex, every grid edge
between two labels one polygon around it (Ju et al. 2002). A vertex is where the planes through the
crossings of its cell's edges meet best, so that the rim where the skin meets a face is sharp as far
as the voxels go. All of it is made once, between the last regions: a piece is bounded by those
polygons that have it on one side only. So neighbours have the same vertices, bit by bit, and
nothing moves when a piece splits.

Where the four corners of a face of the grid are unlike their neighbours, four polygons would meet
in one line. There the two corners that stay one piece longer are joined, and the line becomes two:
every line of a piece then lies between just two of its polygons, whatever the labels are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.pipeline.matter.fragments import components
from gsfluent.pipeline.partition.splits import Splits
from gsfluent.pipeline.partition.tree import Partition

OUTSIDE = -1
"""Label of what is not matter."""
_INSET = 0.01  # a crossing, or a vertex, is so far from the voxels' centres [voxels]
_FIRM = 0.05  # weight of the crossings' mean against their planes, per crossing
_STEPS = 4096.0  # vertices lie on a lattice of this share of a voxel, or finer
_NEVER = 1 << 40


@dataclass(frozen=True, eq=False)
class PieceMesh:
    """The surface of one piece at rest.

    Attributes:
        vertices: [V, 3] in metres, on the lattice of :attr:`Surfaces.step`, float64.
        faces: [F, 3], normals out, int64.
        skin: Which of the triangles are skin, the others are crack faces, bool [F].
        source: Row of each vertex in :attr:`Surfaces.vertices`, int64 [V].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    skin: NDArray[np.bool_]
    source: NDArray[np.int64]

    @property
    def volume(self) -> float:
        """Volume that it encloses [m^3]."""
        a, b, c = (self.vertices[self.faces[:, i]] - self.vertices.mean(axis=0) for i in range(3))
        return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)

    def normals(self) -> NDArray[np.float64]:
        """Unit normals of the vertices [V, 3], by the area around each."""
        return _unit(self._sums(np.ones(len(self.faces), bool)))

    def corner_normals(self) -> NDArray[np.float64]:
        """Unit normals of the triangles' corners [F, 3, 3], sharp where skin meets face."""
        found = np.zeros((*self.faces.shape, 3))
        for sheet in (self.skin, ~self.skin):
            found[sheet] = _unit(self._sums(sheet))[self.faces[sheet]]
        return found

    def _sums(self, some: NDArray[np.bool_]) -> NDArray[np.float64]:
        corners = self.vertices[self.faces[some]]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        total = np.zeros_like(self.vertices)
        for i in range(3):
            np.add.at(total, self.faces[some, i], area)
        return total


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    # what has no area has no direction either: any will do
    return np.where(length > 0.0, vectors / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _Saddles:
    """Faces of the grid where two opposite corners are joined and the other two set apart.

    Corners go round the axis from the node on, edges from corner to corner. Each corner that is set
    apart has a pin: a vertex on the face, between it and the joined ones.

    Attributes:
        key: Ascending: axis times the size of the grid, and the node, int64 [M].
        axis: Along which it faces, int64 [M].
        node: First corner, int64 [M].
        even: Corners 0 and 2 are joined, not 1 and 3; bool [M].
        joined: Labels of those, int64 [M, 2].
    """

    key: Tensor
    axis: Tensor
    node: Tensor
    even: Tensor
    joined: Tensor

    def pin_of(self, key: Tensor, edge: int) -> Tensor:
        """Number of the pin that an edge of a face goes by, 2 per face; -1 off these faces."""
        if len(self.key) == 0:
            return torch.full_like(key, -1)
        row = torch.searchsorted(self.key, key).clamp(max=len(self.key) - 1)
        # corners 1 and 3 are set apart, or 2 and 0
        which = torch.where(self.even[row], int(edge >= 2), int(edge in (0, 3)))
        return torch.where(self.key[row] == key, 2 * row + which, -1)


class Surfaces:
    """All surfaces of a partition, from which pieces take theirs.

    Args:
        partition: Of one body, as finely split as it will be.

    Attributes:
        vertices: [V, 3] in metres, float64.
        triangles: [T, 3]; their normals point from ``inner`` to ``outer``, int64.
        inner: Region behind each triangle, int64 [T].
        outer: Region before it, :data:`OUTSIDE` at the skin, int64 [T].
        step: Edge of the lattice on which vertices lie [m], a power of two: differences of vertices
            and other places of it have no rounding.
    """

    def __init__(self, partition: Partition) -> None:
        self._partition = partition
        self.step = 2.0 ** math.floor(math.log2(partition.voxel / _STEPS))
        self._depth = partition.depth - _level(partition)
        region = torch.where(self._depth > 0.0, partition.region.long(), OUTSIDE)
        # a rim of nothing, so that everything is closed
        self._label = torch.nn.functional.pad(region, (1,) * 6, value=OUTSIDE)
        shape = self._label.shape
        self._stride = (shape[1] * shape[2], shape[2], 1)
        self._flat = self._label.view(-1)
        edges = [self._crossing(axis) for axis in range(3)]
        self._edge_key = torch.cat([axis * self._flat.numel() + e for axis, e in enumerate(edges)])
        self._axis = torch.cat([torch.full_like(e, axis) for axis, e in enumerate(edges)])
        self._node = torch.cat(edges)
        strides = torch.tensor(self._stride, device=self._node.device)
        self._ends = torch.stack([self._node, self._node + strides[self._axis]], dim=1)
        self._sides = self._flat[self._ends]
        share, normal = self._hermite()
        self._point = self._place(self._node)
        self._point[torch.arange(len(share)), self._axis] += share
        self._build(normal)

    def mesh(self, regions: list[int]) -> PieceMesh:
        """The closed surface around some regions.

        Args:
            regions: Which; those of one piece at any time of the tree.

        Returns:
            Watertight, and with one fan of triangles around every vertex.
        """
        mine = torch.tensor(sorted(regions), device=self.triangles.device)
        behind, before = torch.isin(self.inner, mine), torch.isin(self.outer, mine)
        kept = behind != before
        faces = self.triangles[kept]
        faces = torch.where(behind[kept, None], faces, faces.flip(1))
        old, faces = _fans(faces)
        vertices = self.vertices[old]
        other = torch.where(behind, self.outer, self.inner)[kept]
        skin = other == OUTSIDE
        return PieceMesh(*(part.cpu().numpy() for part in (vertices, faces, skin, old)))

    @property
    def on_skin(self) -> Tensor:
        """Which of the vertices touch the skin, bool [V]."""
        found = torch.zeros(len(self.vertices), dtype=torch.bool, device=self.vertices.device)
        outer = (self.inner == OUTSIDE) | (self.outer == OUTSIDE)
        found[self.triangles[outer].view(-1)] = True
        return found

    # --- crossings ---

    def _crossing(self, axis: int) -> Tensor:
        """Nodes whose edge along an axis has two labels, ascending."""
        count = self._label.shape[axis] - 1
        unlike = self._label.narrow(axis, 0, count) != self._label.narrow(axis, 1, count)
        x, y, z = unlike.nonzero().unbind(dim=1)
        return x * self._stride[0] + y * self._stride[1] + z

    def _place(self, node: Tensor) -> Tensor:
        """Indices of nodes in the padded grid, float64 [M, 3]."""
        parts = [node // self._stride[0], node // self._stride[1] % self._label.shape[1],
                 node % self._stride[1]]  # fmt: skip
        return torch.stack(parts, dim=1).double()

    def _hermite(self) -> tuple[Tensor, Tensor]:
        """Where each edge is crossed, 0 to 1 along it, and the surface's unit normal there."""
        partition, count = self._partition, len(self._node)
        share = torch.full((count,), 0.5, dtype=torch.float64, device=self._node.device)
        normal = torch.zeros(count, 3, dtype=torch.float64, device=self._node.device)
        voxel = self._place(self._ends.view(-1)).long().view(count, 2, 3) - 1
        skin = (self._sides == OUTSIDE).any(dim=1)
        depth = torch.nn.functional.pad(self._depth, (1,) * 6, value=-partition.voxel)
        value = depth.view(-1)[self._ends[skin]].double()
        share[skin] = value[:, 0] / (value[:, 0] - value[:, 1])
        normal[skin] = _gradient(depth, voxel[skin] + 1).double().sum(dim=1)
        for split in partition.splits:
            low = torch.tensor(split.low, device=voxel.device)
            size = torch.tensor(split.face.shape, device=voxel.device)
            inside = ((voxel >= low) & (voxel < low + size)).all(dim=(1, 2)) & ~skin
            rows = inside.nonzero()[:, 0]
            at = voxel[rows] - low
            label = split.labels.first[at.unbind(dim=2)].long()
            # of these two this split made two pieces; no other did
            apart = (label >= 0).all(dim=1) & (label[:, 0] != label[:, 1])
            rows, at, label = rows[apart], at[apart], label[apart]
            far = split.face[at.unbind(dim=2)].double() + 1e-9 * partition.voxel
            share[rows] = far[:, 0] / far.sum(dim=1)
            slope = torch.zeros_like(normal[rows])
            seen, of = Splits([split]), torch.zeros_like(label[:, 0])
            for end in (0, 1):
                place = at[:, end] + low
                slope += seen.slope(of, label[:, 0], place, partition.voxel)[1].double()
            normal[rows] = slope
        length = normal.norm(dim=1, keepdim=True)
        along = torch.nn.functional.one_hot(self._axis, 3).double()
        normal = torch.where(length > 0.0, normal / length.clamp(min=1e-300), along)
        return share.clamp(_INSET, 1.0 - _INSET), normal

    # --- polygons ---

    def _build(self, normal: Tensor) -> None:
        """Vertices and triangles."""
        stride, node, axis = self._stride, self._node, self._axis
        strides = torch.tensor(stride, device=node.device)
        b, c = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        around = torch.stack([node, node - b, node - b - c, node - c], dim=1)
        cells, corner = torch.unique(around, return_inverse=True)
        faces, first = self._saddles(), len(cells)
        # between one cell and the next lies a face, of which this edge is one of four
        size, after, before = self._flat.numel(), (axis + 1) % 3, (axis + 2) % 3
        between = (
            (after * size + node, 3), (before * size + node - b, 2),
            (after * size + node - c, 1), (before * size + node, 0),
        )  # fmt: skip
        pins = torch.stack([faces.pin_of(*which) for which in between], dim=1)
        plain = (pins < 0).all(dim=1)
        pins = torch.where(pins < 0, pins, pins + first)
        places = [
            self._cell_vertices(cells, corner, normal),
            self._pin_places(faces),
            self._point[~plain],
        ]
        pinned = first + torch.arange(2 * len(faces.key), device=node.device).view(-1, 2)
        first += pinned.numel()
        middle = first + torch.arange(int((~plain).sum()), device=node.device)
        place = torch.cat(places)
        quads = corner[plain]
        diagonals = [(place[quads[:, i]] - place[quads[:, i + 2]]).norm(dim=1) for i in (0, 1)]
        turned = torch.where((diagonals[1] < diagonals[0])[:, None], quads.roll(-1, 1), quads)
        parts = [turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]]
        sides = [self._sides[plain]] * 2
        # those with pins have a vertex of their own in the middle, or lines would lie on lines
        for i in range(4):
            here, then = corner[~plain, i], corner[~plain, (i + 1) % 4]
            pin = pins[~plain, i]
            held = pin >= 0
            for rows, one, two in (
                (~held, here, then), (held, here, pin), (held, pin, then),
            ):  # fmt: skip
                parts.append(torch.stack([middle, one, two], dim=1)[rows])
                sides.append(self._sides[~plain][rows])
        # between joined corners that are no longer one piece
        apart = faces.joined[:, 0] != faces.joined[:, 1]
        near = torch.searchsorted(cells, faces.node - strides[faces.axis])[apart]
        beyond = torch.searchsorted(cells, faces.node)[apart]
        one, two = pinned[apart].unbind(dim=1)
        parts += [torch.stack([one, near, two], dim=1), torch.stack([one, two, beyond], dim=1)]
        sides += [faces.joined[apart]] * 2
        self.triangles, side = torch.cat(parts), torch.cat(sides)
        self.inner, self.outer = side.unbind(dim=1)
        partition = self._partition
        metres = (place - 1.0) * partition.voxel + partition.origin
        self.vertices = (metres / self.step).round() * self.step

    def _cell_vertices(self, cells: Tensor, corner: Tensor, normal: Tensor) -> Tensor:
        """One place in each cell: nearest to the planes of its crossings [padded voxels]."""
        count = len(cells)

        def summed(values: Tensor) -> Tensor:
            total = values.new_zeros(count, *values.shape[1:])
            for side in range(4):
                total.index_add_(0, corner[:, side], values)
            return total

        many = summed(torch.ones_like(normal[:, 0]))[:, None]
        mean = summed(self._point) / many
        square = summed(normal[:, :, None] * normal[:, None])
        plane = (normal * self._point).sum(dim=1, keepdim=True)
        right = summed(normal * plane) - (square @ mean[:, :, None])[:, :, 0]
        firm = _FIRM * many[:, :, None] * torch.eye(3, dtype=mean.dtype, device=mean.device)
        best = mean + torch.linalg.solve(square + firm, right)
        low = self._place(cells)
        return torch.minimum(torch.maximum(best, low + _INSET), low + 1.0 - _INSET)

    def _saddles(self) -> _Saddles:
        """Faces of the grid where every corner is unlike its two neighbours."""
        size = self._flat.numel()
        crossed = torch.zeros(3 * size, dtype=torch.bool, device=self._flat.device)
        crossed[self._edge_key] = True
        x_y_z = crossed.view(3, size)
        axes, nodes, labels = [], [], []
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            p, q = self._stride[one], self._stride[two]
            node = (x_y_z[one] & x_y_z[two]).nonzero()[:, 0]
            node = node[x_y_z[two][node + p] & x_y_z[one][node + q]]
            axes.append(torch.full_like(node, axis))
            nodes.append(node)
            corners = torch.stack([node, node + p, node + p + q, node + q], dim=1)
            labels.append(self._flat[corners])
        facing, node, label = torch.cat(axes), torch.cat(nodes), torch.cat(labels)
        together = self._together(label)
        even = together[:, 0] > together[:, 1]
        # for as long as each other: the lower one, and matter rather than nothing
        rank = torch.where(label == OUTSIDE, _NEVER, label)
        lower = rank[:, [0, 2]].amin(dim=1) < rank[:, [1, 3]].amin(dim=1)
        even |= (together[:, 0] == together[:, 1]) & lower
        joined = torch.where(even[:, None], label[:, [0, 2]], label[:, [1, 3]])
        return _Saddles(facing * size + node, facing, node, even, joined)

    def _together(self, label: Tensor) -> Tensor:
        """Until which split the two diagonals of faces [M, 4] are one piece each, int64 [M, 2]."""
        ids = torch.unique(self._flat)
        until = torch.full((len(ids), len(ids)), -1, dtype=torch.int64, device=label.device)
        until.fill_diagonal_(_NEVER)
        row = {int(number): place for place, number in enumerate(ids.tolist())}
        held: dict[int, list[int]] = {number: [place] for number, place in row.items()}
        for time in reversed(range(len(self._partition.splits))):
            parts = [held.get(number, []) for number in self._partition.splits[time].ids]
            whole = torch.tensor([place for part in parts for place in part], dtype=torch.int64)
            block = until[whole][:, whole]
            # what no later split has told apart
            start = 0
            for part in parts:
                end = start + len(part)
                block[start:end, :start] = time
                block[start:end, end:] = time
                start = end
            until[whole[:, None], whole] = block
            held[self._partition.splits[time].ids[0]] = whole.tolist()
        place = torch.searchsorted(ids, label)
        return torch.stack([until[place[:, 0], place[:, 2]], until[place[:, 1], place[:, 3]]], 1)

    def _pin_places(self, faces: _Saddles) -> Tensor:
        """Two places on each of some faces, between the crossings around a corner, [2 M, 3]."""
        strides = torch.tensor(self._stride, device=faces.node.device)
        one, two = (faces.axis + 1) % 3, (faces.axis + 2) % 3
        size = self._flat.numel()
        keys = [one * size + faces.node, two * size + faces.node + strides[one],
                one * size + faces.node + strides[two], two * size + faces.node]  # fmt: skip
        point = [self._point[torch.searchsorted(self._edge_key, key)] for key in keys]
        odd = [0.5 * (point[0] + point[1]), 0.5 * (point[2] + point[3])]  # corners 1 and 3
        even = [0.5 * (point[1] + point[2]), 0.5 * (point[3] + point[0])]  # corners 2 and 0
        chosen = [torch.where(faces.even[:, None], *pair) for pair in zip(odd, even, strict=True)]
        return torch.stack(chosen, dim=1).view(-1, 3)


def _level(partition: Partition) -> float:
    """Depth [m] of the surface that encloses the volume of the solid.

    The depth field is 0 a little outside of it, because it smooths the stairs of the voxels.
    """
    edge, wanted = partition.voxel, partition.solid_volume / partition.voxel**3
    near = partition.depth[partition.depth > -edge].double() / edge
    low, high = 0.0, 0.5 * partition.solid_voxel / edge
    for _ in range(20):
        level = 0.5 * (low + high)
        # a voxel is as full as its centre is deep
        full = float((near - level + 0.5).clamp(0.0, 1.0).sum())
        low, high = (level, high) if full > wanted else (low, level)
    return 0.5 * (low + high) * edge


def _fans(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Number vertices anew so that each has one fan of triangles; some had more, touching in it.

    Args:
        faces: Closed, every line between two of them, int64 [F, 3].

    Returns:
        The old number of every vertex, int64 [V], and the faces by the new ones.
    """
    ends = torch.stack([faces, faces.roll(-1, 1)], dim=2).view(-1, 2)
    corner = torch.arange(faces.numel(), device=faces.device).view(faces.shape)
    corners = torch.stack([corner, corner.roll(-1, 1)], dim=2).view(-1, 2)
    low, up = ends.amin(dim=1), ends[:, 0] < ends[:, 1]
    # the two triangles at each line, one beside the other; corners by the lower end first
    order = torch.argsort(low * (int(faces.max()) + 1) + ends.amax(dim=1), stable=True)
    pair = torch.where(up[:, None], corners, corners.flip(1))[order].view(-1, 2, 2)
    root = components(pair[:, 0].reshape(-1), pair[:, 1].reshape(-1), faces.numel())
    names, number = torch.unique(root, return_inverse=True)
    return faces.view(-1)[names], number.view(faces.shape)


def _gradient(field: Tensor, voxel: Tensor) -> Tensor:
    """Differences of a field [X, Y, Z] along its axes, at voxels [..., 3] that have neighbours."""
    size = torch.tensor(field.shape, device=voxel.device)
    parts = []
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.int64, device=voxel.device)
        step[axis] = 1
        ahead = torch.minimum(voxel + step, size - 1).unbind(dim=-1)
        behind = (voxel - step).clamp(min=0).unbind(dim=-1)
        parts.append(field[ahead] - field[behind])
    return torch.stack(parts, dim=-1)
