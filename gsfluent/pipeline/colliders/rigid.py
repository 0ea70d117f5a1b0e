"""The rigid things of a scene while it moves: rows for the grid, and how they advance.

Standing colliders, plates that move for a while, and free bodies are rows of one table
(:func:`gsfluent.ops.collider_row`). The table is part of the state of a simulation: it is kept in
float64, rolled back with the matter, and never written in place.
"""

from __future__ import annotations

import functools
import logging
import math
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Particles
from gsfluent.ops import collider as columns
from gsfluent.pipeline.colliders import patches
from gsfluent.pipeline.colliders.grips import Reactions, grip_row, reactions
from gsfluent.pipeline.colliders.proximity import time_to_meet
from gsfluent.pipeline.liquid.sheet import CLOSED
from gsfluent.scene.parts import turned
from gsfluent.scene.scene import Collider, Scene

_log = logging.getLogger(__name__)

SMALLEST = 0.9
"""A free ball is never smaller than this many cells for the grid, or it could lie between nodes."""
THINNEST = 2.0
"""Cells below which the grid does not hold matter out of a box reliably."""
BACKED = 6.0
"""Least thickness of a plate [cells]: a node that matter at its face reaches (1.5 cells, and what
it sank in) must be nearer to the face than to the back, or it is pushed out of the back."""
_NOTHING = columns.TYPES["nothing"]
_LATTICE_POINTS = 16_000
"""About how many splats draw a shape that has no patches of its own."""
_FLAT = 0.2
"""Their thickness in widths, so that a thin wall and an edge are not rows of balls."""
DENSITY_OF_MESH_VALUES = 0.5
"""Spacing of a mesh's distance grid [cells]."""


class RigidSet:
    """Every rigid collider of a scene.

    Args:
        scene: The scene; its floor is the first row.
        dx: Grid spacing [m].
        device: Device of the rows.
        particles: The points at the start, for grips; without them there are none.

    Attributes:
        start: Rows at time 0, float64 [M, 32].
        sdf: Values of all distance grids, float32 [S], or None.
        names: Name of each row.
        grips: Rows that are grips.
    """

    def __init__(
        self,
        scene: Scene,
        dx: float,
        device: torch.device | str = "cpu",
        particles: Particles | None = None,
    ) -> None:
        self.dx = dx
        self.floor = scene.floor
        self._gravity = scene.gravity
        self._grids: list[Tensor] = []
        self._grid_values = 0
        rows, self.names = [], []
        self._colliders: list[Collider | None] = []
        if scene.floor is not None:
            rows.append(
                ops.collider_row(
                    "plane",
                    point=(0.0, 0.0, scene.floor),
                    mode=scene.floor_mode,
                    friction=scene.floor_friction,
                    stiffer=columns.STIFFEST if any(c.backed for c in scene.colliders) else 0.0,
                )
            )
            self.names.append("floor")
            self._colliders.append(None)
        for collider in scene.colliders:
            if collider.kind != "grip":
                rows.append(self._row(collider))
            elif particles is not None:
                row, values = grip_row(collider, scene, particles, dx, self._grid_values)
                rows.append(row)
                self._add_grid(values)
            else:
                rows.append(ops.collider_row("nothing"))
            self.names.append(collider.name)
            self._colliders.append(collider)
        self.start = (
            torch.stack(rows) if rows else torch.zeros(0, columns.COLLIDER_COLUMNS).double()
        )
        self._motion = self.start[:, [10, 11, 12, 20, 21, 22]].clone()
        self._begin = self.start
        self._types = self.start[:, columns.TYPE].tolist()
        self.start = self.scheduled(self.start, 0.0).to(device)
        self._motion, self._begin = self._motion.to(device), self._begin.to(device)
        self.sdf = torch.cat(self._grids).to(device) if self._grids else None
        self.grips = [
            i for i, c in enumerate(self._colliders) if c is not None and c.kind == "grip"
        ]
        self._pull = math.hypot(*scene.gravity)
        self._free = [
            i for i, c in enumerate(self._colliders) if c is not None and c.mass is not None
        ]

    @property
    def count(self) -> int:
        """Number of rows, the floor included."""
        return self.start.shape[0]

    @property
    def frees(self) -> bool:
        """Whether any of them is a free body."""
        return bool(self._free)

    @functools.cached_property
    def moves(self) -> bool:
        """Whether any of them ever moves, comes or goes."""
        if self.frees or not all(c is None or _steady(c) for c in self._colliders):
            return True
        return bool((self._motion != 0).any())

    def scheduled(self, rows: Tensor, time: float) -> Tensor:
        """Rows from ``time`` on: their velocities (free bodies keep theirs), and who is there.

        A free body that starts later is a row of nothing, without mass, until then.
        """
        if all(c is None or _steady(c) for c in self._colliders):
            return rows
        rows = rows.clone()
        for i, c in enumerate(self._colliders):
            if c is not None and not _steady(c):
                on = c.start <= time < c.stop
                if c.mass is not None:
                    if not on:
                        rows[i] = _waiting(self._begin[i])
                    elif rows[i, columns.TYPE] == _NOTHING:
                        rows[i] = self._begin[i]
                    continue
                motion = self._motion[i] if on else torch.zeros_like(self._motion[i])
                rows[i, 10:13], rows[i, 20:23] = motion[:3], motion[3:]
                rows[i, columns.TYPE] = self._types[i] if c.there(time) else _NOTHING
        return rows

    def next_change(self, time: float) -> float:
        """The next time after ``time`` at which one starts or stops [s], or infinity."""
        changes = [t for c in self._colliders if c is not None for t in (c.start, c.stop)]
        return min((t for t in changes if t > time), default=math.inf)

    def advance(
        self,
        rows: Tensor,
        time: float,
        dt: float,
        impulse: Tensor | None = None,
        torque: Tensor | None = None,
    ) -> Tensor:
        """Rows at ``time + dt``; the step must not pass :meth:`next_change`.

        Args:
            rows: Rows at ``time``, [M, 32].
            time: Time [s].
            dt: Step [s].
            impulse: Given to the matter during the step [N s], float64 [M, 3].
            torque: About each collider's point [N m s], float64 [M, 3].
        """
        if self.count == 0 or not self.moves:
            return rows
        rows = ops.advance_colliders(
            rows, dt, impulse=impulse, torque=torque, gravity=self._gravity
        )
        return self.settled(rows, time + dt)

    def settled(self, rows: Tensor, time: float) -> Tensor:
        """Rows that have just moved to ``time``: free bodies on the floor, plates as scheduled."""
        return self.scheduled(self._rest_on_floor(rows), time)

    def floor_wait(self, rows: Tensor, depth: float) -> float:
        """Least time in which gravity takes a free body to ``depth`` [m] below the floor [s]."""
        if self.floor is None:
            return math.inf
        wait = math.inf
        for i in self._free:
            above = float(rows[i, 5]) - self._reach(i, rows) - self.floor
            down = abs(float(rows[i, 12]))
            wait = min(wait, time_to_meet(max(above, 0.0) + depth, down, self._pull))
        return wait

    def speeds(self, rows: Tensor) -> Tensor:
        """Largest speed of each collider's matter [m/s], [M]."""
        lever = torch.where(rows[:, 0] == 0, 0.0, rows[:, 26:29].norm(dim=1) + rows[:, 9])
        if self.sdf is not None:  # there the extent counts values
            grid = torch.maximum(-rows[:, 6:9], rows[:, 6:9] + (rows[:, 26:29] - 1) * rows[:, 9:10])
            lever = torch.where(rows[:, 0] == columns.TYPES["sdf"], grid.norm(dim=1), lever)
        return rows[:, 10:13].norm(dim=1) + rows[:, 20:23].norm(dim=1) * lever

    def speed(self, rows: Tensor) -> Tensor:
        """Largest speed of any collider's matter [m/s], a tensor [] on the device."""
        return self.speeds(rows).max() if self.moves else rows.new_zeros(())

    def moving(self, rows: Tensor) -> Tensor:
        """Colliders that move, that gravity is about to move, that will go, grips: rows, [K, 32].

        What leans on something that will go must not sleep: nobody would wake it. What a grip holds
        must not, as nobody would book the reaction.
        """
        if not self.moves and not self.grips:
            return rows[:0]
        active = self.speeds(rows) > 0.0
        active[self.grips] |= rows[self.grips, columns.TYPE] != _NOTHING
        for i, c in enumerate(self._colliders):
            if c is not None and math.isfinite(c.vanishes):
                active[i] |= rows[i, columns.TYPE] != _NOTHING
        for i in self._free if self._pull > 0.0 else ():
            bottom = float(rows[i, 5]) - self._reach(i, rows)
            active[i] |= self.floor is None or bottom > self.floor + 1e-9
        return rows[active]

    def work(self, rows: Tensor, impulse: Tensor, torque: Tensor) -> Tensor:
        """Most energy that the colliders can have given to the matter in a step [J], []."""
        given = (impulse * rows[:, 10:13]).sum() + (torque * rows[:, 20:23]).sum()
        return given.clamp(min=0.0)

    def work_between(self, rows: Tensor, now: Tensor, impulse: Tensor, torque: Tensor) -> Tensor:
        """The same over many steps, during which nothing but matter and gravity acted [J], [].

        Args:
            rows: Rows before, [M, 32].
            now: Rows after.
            impulse: Given to the matter between them [N s], float64 [M, 3].
            torque: About each collider's point [N m s], float64 [M, 3].
        """
        if not self.moves:  # who stands gives nothing
            return rows.new_zeros(())
        device = rows.device  # a few numbers: on a GPU each operation would cost a launch
        rows, now, impulse, torque = (v.cpu() for v in (rows, now, impulse, torque))
        given = (impulse * rows[:, 10:13]).sum(dim=1) + (torque * rows[:, 20:23]).sum(dim=1)
        pull = torch.tensor(self._gravity, dtype=rows.dtype)
        fallen = rows[:, columns.MASS] * ((now[:, 3:6] - rows[:, 3:6]) @ pull)
        # A free body gives what it loses of its own energy.
        lost = _kinetic(rows) - _kinetic(now) + fallen
        return torch.where(rows[:, columns.MASS] > 0.0, lost, given).sum().clamp(min=0).to(device)

    def touchable(self, rows: Tensor) -> Tensor:
        """Volume of grid nodes that each free body can touch, its lever counted in [m^3], [M].

        The box around the body, half a cell wider; times ``1 + m r^2 / I`` for what its turning
        gives way (``collider_give`` in ``csrc/core/collider/collider.h``). 0 for other colliders.
        """
        volume = rows.new_zeros(rows.shape[0])
        for i in self._free:
            row = rows[i]
            kind, radius, half = int(row[0]), float(row[9]), row[26:29]
            if kind == 1:
                half = torch.full_like(half, radius)
            elif kind in (3, 4):
                half = torch.stack([half[2] * 0 + radius, half[2] * 0 + radius, half[2] + radius])
            elif kind == 5:
                half = torch.maximum(-row[6:9], row[6:9] + (half - 1) * radius)
            box = geometry.product(2.0 * half + self.dx)
            moments = row[columns.INERTIA : columns.EXTENT]
            turns = 0.0
            if bool((moments > 0).any()):
                turns = float(row[columns.MASS]) * self._bound(row) ** 2
                turns /= float(moments[moments > 0].min())
                if kind == 1:  # only friction turns a ball
                    turns *= float(row[2] ** 2 / (1.0 + row[2] ** 2))
            volume[i] = box * (1.0 + turns) * (math.pi / 6.0 if kind == 1 else 1.0)
        return volume

    def gaps(self, rows: Tensor, low: Tensor, high: Tensor) -> list[float]:
        """Lower bounds of the distance between the colliders and boxes [m].

        Args:
            rows: Rows of the colliders, [M, 32].
            low: Low corners [m], [K, 3].
            high: High corners.
        """
        if rows.shape[0] == 0 or low.shape[0] == 0:
            return [math.inf] * low.shape[0]
        low, high = low.to(rows), high.to(rows)
        edges = high - low
        lattice = torch.cartesian_prod(*[torch.linspace(0, 1, 5, dtype=rows.dtype)] * 3)
        at = low[:, None] + lattice.to(rows.device) * edges[:, None]
        distance, _ = ops.collider_distance(at.reshape(-1, 3), rows, self.sdf)
        distance = distance.reshape(*at.shape[:2], -1).amin(dim=1)
        # No place of the box is further from the lattice than half a lattice cell's diagonal. From
        # an endless plane the corners are nearest.
        endless = (rows[:, columns.TYPE] == 0) & (rows[:, columns.RADIUS] == 0)
        slack = torch.where(endless, 0.0, 0.125 * edges.norm(dim=1, keepdim=True))
        result: list[float] = (distance - slack).amin(dim=1).tolist()
        return result

    def surfaces(self, rows: Tensor) -> patches.Patches | None:
        """Flat splats on the surfaces of all colliders but endless planes, to draw them.

        Args:
            rows: Rows, [M, 32].

        Returns:
            The splats in scene metres, or None when there is nothing to draw.
        """
        found = []
        for collider, one in zip(self._colliders, rows, strict=True):
            if collider is not None and not collider.shown:
                continue
            row = self._drawn(collider, one)
            if math.isfinite(self._bound(row)):
                found.append(self._surface(row))
        return patches.joined(found) if found else None

    def _surface(self, row: Tensor) -> patches.Patches:
        kind, radius = int(row[columns.TYPE]), float(row[columns.RADIUS])
        x, y, z = row[columns.EXTENT : columns.EXTENT + 3].tolist()
        if kind == columns.TYPES["sphere"]:
            made = patches.sphere(radius)
        elif kind == columns.TYPES["box"]:
            made = patches.box((x, y, z))
        elif kind == columns.TYPES["cylinder"]:
            made = patches.cylinder(radius, z)
        else:
            return self._projected(row)
        quaternion = row[columns.ORIENTATION : columns.ORIENTATION + 4]
        turn = geometry.quaternion_to_matrix(quaternion[None].double())[0]
        place = row[columns.POINT : columns.POINT + 3].double()
        made = patches.Patches(*(part.to(row.device) for part in made))
        return made.moved(turn, place)

    def _projected(self, row: Tensor) -> patches.Patches:
        """A lattice's points near a surface of any shape, put onto it."""
        bound = self._bound(row)
        # A ball of this radius has about this many points of a lattice on its surface.
        step = bound * math.sqrt(12.0 / _LATTICE_POINTS)
        side = math.ceil(bound / step)
        axis = torch.arange(-side, side + 1, dtype=row.dtype, device=row.device) * step
        at = row[3:6] + torch.cartesian_prod(axis, axis, axis)
        distance, normal = ops.collider_distance(at, row[None], self.sdf)
        near = distance[:, 0].abs() <= 0.5 * step
        normal = normal[near, 0].double()
        points = (at[near] - distance[near] * normal).double()
        sizes = points.new_tensor(CLOSED * step) * points.new_tensor([1.0, 1.0, _FLAT])
        return patches.Patches(points, patches.upright(normal), sizes.expand_as(points))

    def _drawn(self, c: Collider | None, row: Tensor) -> Tensor:
        """The row as it was asked for, not as the grid needs it."""
        if c is None or not (c.backed or c.kind == "sphere"):
            return row
        row = row.clone()
        if c.kind == "sphere":
            row[9] = c.radius
            return row
        behind = float(row[28]) - 0.5 * c.size[2]
        row[3:6] += row.new_tensor(turned(c.orientation, (0.0, 0.0, behind)))
        row[28] = 0.5 * c.size[2]
        return row

    def _bound(self, row: Tensor) -> float:
        kind, radius = int(row[0]), float(row[9])
        half = row[26:29]
        if kind == 1:
            return radius
        if kind == 2:
            return float(half.norm())
        if kind in (3, 4):
            return radius + float(half[2])
        if kind == 5:
            return float(torch.maximum(-row[6:9], row[6:9] + (half - 1) * radius).norm())
        return math.inf

    def _row(self, c: Collider) -> Tensor:
        volume, inertia, extra = self._shape(c)
        mass = c.mass or 0.0
        point, velocity = list(c.point), list(c.velocity)
        shape: dict[str, Any] = {"point": point, "orientation": c.orientation} | extra
        if c.backed:
            half = 0.5 * max(c.size[2], BACKED * self.dx)
            back = turned(c.orientation, (0.0, 0.0, 0.5 * c.size[2] - half))
            shape["point"] = [a + b for a, b in zip(point, back, strict=True)]
            shape["extent"] = [0.5 * c.size[0], 0.5 * c.size[1], half]
        elif c.kind == "box" and min(c.size) < THINNEST * self.dx:
            _log.warning(
                "%s is %.3g m thin, under %g cells of %.3g m: matter may pass through it",
                c.name, min(c.size), THINNEST, self.dx,
            )  # fmt: skip
        if c.kind == "mesh":
            shape["point"] = [a + b for a, b in zip(point, extra["point"], strict=True)]
        return ops.collider_row(
            "sdf" if c.kind == "mesh" else c.kind,
            mode=c.mode,
            friction=c.friction,
            velocity=velocity,
            angular_velocity=c.angular_velocity,
            mass=mass,
            inertia=[mass / volume * moment for moment in inertia] if mass else (0.0, 0.0, 0.0),
            sweep=mass > 0.0,
            stiffer=columns.STIFFEST if c.backed else 0.0,
            **shape,
        )

    def _shape(self, c: Collider) -> tuple[float, list[float], dict[str, Any]]:
        """Volume, principal moments at unit density, and the shape's columns."""
        r, length, size = c.radius, c.length, c.size
        if c.kind == "plane":
            return 1.0, [0.0] * 3, {"normal": list(c.normal), "radius": r}
        if c.kind == "sphere":
            volume = 4.0 / 3.0 * math.pi * r**3
            drawn = max(r, SMALLEST * self.dx) if c.mass is not None else r
            return volume, [0.4 * volume * r * r] * 3, {"radius": drawn}
        if c.kind == "box":
            volume = math.prod(size)
            squares = [edge * edge for edge in size]
            moments = [volume / 12.0 * (sum(squares) - square) for square in squares]
            return volume, moments, {"extent": [0.5 * edge for edge in size]}
        if c.kind in ("cylinder", "capsule"):
            bar = math.pi * r * r * length
            caps = 4.0 / 3.0 * math.pi * r**3 if c.kind == "capsule" else 0.0
            along = bar * r * r / 2.0 + caps * 0.4 * r * r
            across = bar * (r * r / 4.0 + length * length / 12.0)
            across += caps * (0.4 * r * r + 0.375 * r * length + 0.25 * length * length)
            extra = {"radius": r, "extent": [0.0, 0.0, 0.5 * length]}
            return bar + caps, [across, across, along], extra
        return self._mesh(c)

    def _mesh(self, c: Collider) -> tuple[float, list[float], dict[str, Any]]:
        from gsfluent.spatial.mesh_distance import mesh_body

        assert c.mesh is not None
        body = mesh_body(c.mesh, c.scale, DENSITY_OF_MESH_VALUES * self.dx)
        values = torch.from_numpy(body.values).flatten()
        pad = -values.shape[0] % columns.SDF_ALIGN
        offset = self._add_grid(torch.nn.functional.pad(values, (0, pad)))
        turn = geometry.quaternion_to_matrix(torch.tensor([c.orientation]).double())[0]
        axes = torch.from_numpy(body.axes.copy())
        extra = {
            "point": (turn @ torch.from_numpy(body.center.copy())).tolist(),
            "orientation": quaternion_of(turn @ axes),
            "normal": body.corner.tolist(),
            "radius": body.spacing,
            "extent": list(body.values.shape),
            "offset": offset,
        }
        return body.volume, body.inertia.tolist(), extra

    def _add_grid(self, values: Tensor) -> int:
        """Put values, as many as :data:`SDF_ALIGN` divides, behind the others; where they begin."""
        offset = self._grid_values
        self._grids.append(values)
        self._grid_values += values.shape[0]
        return offset

    def reactions(self, rows: Tensor, given: Tensor, seconds: float) -> Reactions:
        """What the grips did in a span of time: see :func:`.grips.reactions`."""
        names = [self.names[i] for i in self.grips]
        return reactions(names, self._begin[self.grips], rows[self.grips], given, seconds)

    def _reach(self, i: int, rows: Tensor) -> float:
        """How far free body i can reach below its point [m]."""
        c = self._colliders[i]
        return c.radius if c is not None and c.kind == "sphere" else self._bound(rows[i])

    def _rest_on_floor(self, rows: Tensor) -> Tensor:
        """Stop free bodies at the floor: rigid things do not collide with each other otherwise."""
        if self.floor is None:
            return rows
        if not self._free:
            return rows
        rows = rows.clone()
        for i in self._free:
            reach = self._reach(i, rows)
            down = rows[i, 5] < self.floor + reach
            rows[i, 5] = rows[i, 5].clamp(min=self.floor + reach)
            rows[i, 12] = torch.where(down, rows[i, 12].clamp(min=0.0), rows[i, 12])
        return rows


def _kinetic(rows: Tensor) -> Tensor:
    """Kinetic energy of each collider with mass [J], [M]."""
    turning = rows[:, columns.ANGULAR_VELOCITY : columns.INERTIA]
    frame = geometry.quaternion_to_matrix(rows[:, columns.ORIENTATION : columns.ANGULAR_VELOCITY])
    along = (frame.mT @ turning[..., None])[..., 0]
    spin = (rows[:, columns.INERTIA : columns.EXTENT] * along**2).sum(dim=1)
    return 0.5 * (rows[:, columns.MASS] * (rows[:, 10:13] ** 2).sum(dim=1) + spin)


def _waiting(row: Tensor) -> Tensor:
    """A free body before its start."""
    row = row.clone()
    row[columns.TYPE] = _NOTHING
    for first, last in ((10, 13), (columns.ANGULAR_VELOCITY, columns.EXTENT)):
        row[first:last] = 0.0
    row[columns.MASS] = 0.0
    return row


def _steady(c: Collider) -> bool:
    """Whether a collider needs no schedule: moving (or standing, or free) from the start on."""
    return c.start <= 0.0 and math.isinf(c.stop)


def quaternion_of(matrix: Tensor) -> list[float]:
    """Unit quaternion w, x, y, z of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix.numpy()).as_quat().tolist()
    return [w, x, y, z]
