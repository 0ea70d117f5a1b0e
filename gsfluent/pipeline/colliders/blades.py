"""Blades of a scene while they move: who lies on which side, which fields move as one, faces.

A zero-thickness blade changes nothing but this: particles beside the sheet it has swept get a side,
and fields on opposite sides of a blade are in contact instead of moving as one. Nothing is removed
or broken, and ahead of the edge the body is whole. A thick blade also pushes the sides apart with
the faces of a rigid wedge and slab, each of which meets only the matter on its own side.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.errors import InputError
from gsfluent.ops.blade import MAX_BLADES, cut_apart
from gsfluent.pipeline.colliders.rigid import quaternion_of
from gsfluent.scene.scene import Blade, Scene

REACH = 3.0
"""Distance from the sheet [cells] within which matter gets a side: the reach of two kernels (1.5
each), so that matter without a side shares no node with matter of the other side."""
BEHIND = 2.0
"""Distance at which the faces follow the edge [cells]: matter ahead of it reaches nodes 1.5 behind
it, where the body is whole, and half a look is 0.5."""
TAPER = 0.25
"""Rise of the wedge of a thick blade per length behind its edge."""
MAX_FIELDS = 64
"""Fields of the composed operators at most."""
_CORNER = 1e-9
"""Share of a leg within which an edge is at its end."""


class Fields(NamedTuple):
    """Velocity fields of a cut scene.

    Attributes:
        field: Field of each particle, int32 [N].
        parent: Body of each field, int32 [K].
        cut: Sides of each field, int32 [K].
        merged: Pairs of fields that move as one, bool [K, K].
    """

    field: Tensor
    parent: Tensor
    cut: Tensor
    merged: Tensor

    @property
    def total(self) -> int:
        """Number of fields, K."""
        return self.parent.shape[0]


class BladeSet:
    """Every blade of a scene.

    Args:
        scene: The scene.
        dx: Grid spacing [m].

    Raises:
        InputError: More blades than there are sides to give.
    """

    def __init__(self, scene: Scene, dx: float) -> None:
        self.blades = tuple(scene.blades)
        self.dx = dx
        if len(self.blades) > MAX_BLADES:
            raise InputError(
                f"simulate: {len(self.blades)} blades are more than {MAX_BLADES}",
                hint="give one blade a longer path",
            )

    def __len__(self) -> int:
        """Number of blades."""
        return len(self.blades)

    def ends(self, number: int) -> tuple[float, float]:
        """Times at which a blade starts and has passed its path [s]."""
        blade = self.blades[number]
        return blade.start, blade.start + _length(blade) / blade.speed

    def next_change(self, time: float) -> float:
        """The next time after ``time`` at which a blade starts, turns or ends [s], or infinity."""
        times = [t for number in range(len(self)) for t in self.ends(number)]
        for blade in self.blades:
            passed = itertools.accumulate(
                math.dist(a, b) for a, b in itertools.pairwise(blade.path)
            )
            times += [blade.start + length / blade.speed for length in passed]
        return min((t for t in times if t > time), default=math.inf)

    def speed(self, time: float) -> float:
        """Speed of the fastest blade that moves [m/s]."""
        speeds = [
            blade.speed
            for number, blade in enumerate(self.blades)
            if self.ends(number)[0] <= time < self.ends(number)[1]
        ]
        return max(speeds, default=0.0)

    def gap(self, low: Tensor, high: Tensor, time: float) -> float:
        """Lower bound of the distance of a box from the way of the blades that move [m]."""
        nearest = math.inf
        for number, blade in enumerate(self.blades):
            start, end = self.ends(number)
            if not start <= time < end:
                continue
            path = torch.tensor(blade.path, dtype=torch.float64)
            reach = 0.5 * blade.width * torch.tensor(blade.edge, dtype=torch.float64).abs()
            reach = reach + 0.5 * blade.thickness
            apart = torch.maximum(
                path.amin(dim=0) - reach - high.cpu(), low.cpu() - path.amax(dim=0) - reach
            )
            nearest = min(nearest, float(apart.clamp(min=0.0).norm()))
        return nearest

    def moving(self, before: float, now: float) -> bool:
        """Whether any blade moves between two times."""
        return any(a < now and b > before for a, b in map(self.ends, range(len(self))))

    def rows(self, before: float, now: float) -> Tensor:
        """Rows of :func:`gsfluent.ops.blade_sides` for the time between two looks, [L, 16].

        The strip begins a cell behind the place of the last look, for matter that was carried
        across it since.
        """
        rows = []
        for number, blade in enumerate(self.blades):
            low, high = (blade.speed * (time - blade.start) for time in (before, now))
            if high > 0.0 and low < _length(blade):
                swept = (max(low - self.dx, 0.0), high)
                rows.append(
                    ops.blade_rows(blade.path, blade.edge, blade.width, swept=swept, number=number)
                )
        return torch.cat(rows) if rows else torch.zeros(0, 16, dtype=torch.float64)

    def look(self, position: Tensor, cut: Tensor, before: float, now: float) -> Tensor:
        """Sides of all particles after the edges moved from ``before`` to ``now``, int32 [N].

        Args:
            position: Positions at ``now`` [m], [N, 3].
            cut: Sides at ``before``, int32 [N].
            before: Time of the last look [s].
            now: Time [s]. Between two looks an edge should move by a cell at most.
        """
        rows = self.rows(before, now)
        if rows.shape[0] == 0:
            return cut
        return ops.blade_sides(position, rows.to(position), cut, REACH * self.dx)

    def splits(self, body: Tensor, cut: Tensor) -> Tensor:
        """Bodies that have matter on both sides of some blade: their numbers, [S]."""
        found = torch.unique(body.to(torch.int64) << 32 | cut.to(torch.int64))
        parent, sides = found >> 32, found & 0xFFFFFFFF
        same = parent[:, None] == parent[None, :]
        return torch.unique(parent[(same & cut_apart(sides[:, None], sides[None, :])).any(dim=1)])

    def fields(
        self, body: Tensor, cut: Tensor, *, pushed: bool | None = None, most: int = MAX_FIELDS
    ) -> Fields:
        """Number the fields: every pair of a body and its sides that occurs.

        Sides matter only in bodies that have matter on both sides of a blade, or that the faces of
        a thick blade must know.

        Args:
            body: Body of each point, int [N].
            cut: Its sides, int32 [N].
            pushed: Whether faces must know the sides; by default, when a blade is thick.
            most: Fields at most.

        Raises:
            InputError: More fields.
        """
        if pushed is None:
            pushed = any(blade.thickness > 0.0 for blade in self.blades)
        if not pushed:
            cut = torch.where(torch.isin(body, self.splits(body, cut)), cut, 0)
        key = body.to(torch.int64) << 32 | cut.to(torch.int64)
        found, field = torch.unique(key, return_inverse=True)
        if found.shape[0] > most:
            raise InputError(
                f"simulate: {found.shape[0]} parts on different sides of blades are more than "
                f"{most}",
                hint="use fewer blades or bodies",
            )
        parent, sides = (found >> 32).to(torch.int32), (found & 0xFFFFFFFF).to(torch.int32)
        return Fields(field.to(torch.int32), parent, sides, ops.merged_fields(parent, sides))

    def faces(self, time: float) -> Tensor:
        """Collider rows of the thick blades at a time, float64 [F, 32].

        Per side of each leg that the edge has entered: a wedge that rises :data:`BEHIND` the edge,
        and the slab behind it. A blade that has passed its path is drawn out and has none.
        """
        rows = []
        for number, blade in enumerate(self.blades):
            start, end = self.ends(number)
            if blade.thickness <= 0.0 or not start < time <= end:
                continue
            swept = blade.speed * (time - start) - BEHIND * self.dx
            for a, b in itertools.pairwise(blade.path):
                length = math.dist(a, b)
                if swept > _CORNER * length:
                    leads = swept <= (1.0 + _CORNER) * length
                    rows += self._leg(number, blade, a, b, min(swept, length), leads)
                swept -= length
        return torch.stack(rows) if rows else torch.zeros(0, 32, dtype=torch.float64)

    def _leg(
        self, number: int, blade: Blade, a: tuple[float, ...], b: tuple[float, ...],
        swept: float, leading: bool,
    ) -> list[Tensor]:  # fmt: skip
        start, end, edge = (torch.tensor(v, dtype=torch.float64) for v in (a, b, blade.edge))
        way = (end - start) / (end - start).norm()
        way = way - (way @ edge) * edge
        way = way / way.norm()
        up = torch.linalg.cross(edge, way)
        half = 0.5 * blade.thickness
        run = min(half / TAPER, swept) if leading else 0.0
        middle = start + swept * (end - start) / (end - start).norm()
        velocity = (blade.speed * way if leading else 0.0 * way).tolist()
        rows = []
        for bit, normal in ((0, up), (1, -up)):
            pieces = []
            if run > 0.0:
                wedge = (normal + TAPER * way) / math.hypot(1.0, TAPER)
                center = middle - 0.5 * run * (way - TAPER * normal)
                pieces.append((center, wedge, 0.5 * run * math.hypot(1.0, TAPER)))
            if swept > run:
                center = middle - 0.5 * (swept + run) * way + half * normal
                pieces.append((center, normal, 0.5 * (swept - run)))
            for point, out, reach in pieces:
                rows.append(
                    ops.collider_row(
                        "face",
                        point=point.tolist(),
                        orientation=_turn(tuple(edge.tolist()), tuple(out.tolist())),
                        extent=(0.5 * blade.width, reach, REACH * self.dx),
                        velocity=velocity,
                        only_cut=2 * number + bit + 1,
                    )
                )
        return rows


@functools.cache  # asked again at every look, for few directions
def _turn(edge: tuple[float, ...], out: tuple[float, ...]) -> list[float]:
    """Quaternion of a face along ``edge`` whose normal is ``out``."""
    x, z = (torch.tensor(way, dtype=torch.float64) for way in (edge, out))
    return quaternion_of(torch.stack([x, torch.linalg.cross(z, x), z], dim=1))


def _length(blade: Blade) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise(blade.path))
