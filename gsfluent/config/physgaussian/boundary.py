"""Boundary conditions of PhysGaussian's configs as colliders, floor and events of a shot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.config.physgaussian.keys import (
    BOUNDARIES,
    INERT,
    NEAR,
    UNSUPPORTED,
    Note,
    number,
    numbers,
)
from gsfluent.config.physgaussian.space import Space, turn_of, turn_to
from gsfluent.errors import InputError

Array = NDArray[np.float64]
WALL_CELLS = 2.5
"""Their walls stop nodes 0, 1 and 2 of the grid: here they stand half a cell further."""
LAYERS = 50
"""What PhysGaussian releases sequentially it always releases in so many layers."""
ROOM = 0.01
"""Least height of the object above a plane that becomes the floor [m]."""


class Boundaries:
    """Turns conditions into parts of a shot.

    Args:
        values: The config.
        space: Its box.
        points: Their coordinates of the Gaussians, [N, 3].
        mass: Mass that PhysGaussian gives to each Gaussian [kg], [N].
        seconds: Length of the simulation [s].

    Attributes:
        colliders, events: Of the shot.
        floor: Height of the floor above (1, 1, 1) along +z of the scene [m], or None.
        floor_keys: ``floor_mode`` and ``floor_friction`` of it.
        notes: What became of each condition.
    """

    def __init__(
        self, values: Mapping[str, Any], space: Space, points: Array, mass: Array, seconds: float
    ) -> None:
        self.values, self.space = values, space
        self.points, self.mass, self.seconds = points, mass, seconds
        self.colliders: list[dict[str, Any]] = []
        self.events: list[dict[str, Any]] = []
        self.floor: float | None = None
        self.floor_keys: dict[str, Any] = {}
        self.notes: list[Note] = []
        self._lowest = float((space.upright @ (points - 1.0).T)[2].min())
        self._place, self._entry = "", {}
        conditions = list(enumerate(values.get("boundary_conditions", [])))
        # the walls last: a surface above their lowest one is the better floor
        for i, entry in sorted(conditions, key=lambda one: one[1]["type"] == "bounding_box"):
            self._place, self._entry = f"boundary_conditions[{i}].", entry
            getattr(self, f"_{entry['type']}")()
            status, text = BOUNDARIES[entry["type"]][:2]
            self.notes.append(Note(f"{self._place}type {entry['type']}", status, text))

    def _number(self, key: str, default: float = 0.0) -> float:
        return number(self._entry, key, default, self._place)

    def _vector(self, key: str, default: list[float] | None = None) -> list[float]:
        return numbers(self._entry, key, default or [1.0, 1.0, 1.0], self._place)

    def _note(self, key: str, status: str, text: str) -> None:
        self.notes.append(Note(self._place + key, status, text))

    def _while(self, start: float, end: float) -> dict[str, float] | None:
        """Keys of a collider that is there from start to end, or None if that is never."""
        if end <= start or start >= self.seconds or end <= 0.0:
            return None
        keys = {"appears": round(start, 9)} if start > 0.0 else {}
        return keys | ({"vanishes": round(end, 9)} if end < self.seconds else {})

    def _add(self, kind: str, start: float, end: float, **keys: Any) -> None:
        there = self._while(start, end)
        if there is None:
            self._note("end_time", INERT, f"never in force during {self.seconds:g} s")
            return
        hidden = {} if kind == "plane" else {"shown": False}
        self.colliders.append({"type": kind, "mode": "sticky"} | keys | there | hidden)

    def _box(self, point: list[float], half: list[float], start: float, end: float,
             velocity: list[float]) -> None:  # fmt: skip
        keys = {} if self.space.aligned else {"turn": turn_of(self.space.upright)}
        moved = self.space.way(velocity)
        if any(moved):
            keys["velocity"] = moved
        at, size = self.space.place(point), self.space.edges(half)
        self._add("box", start, end, at=at, size=size, **keys)

    def _cuboid(self) -> None:
        start, end = self._number("start_time"), self._number("end_time", 1e3)
        self._box(self._vector("point"), self._vector("size"), start, end, self._vector("velocity"))
        if self._entry.get("reset", 0) == 1:
            text = "it would stop all matter before start_time and for 15 steps after end_time"
            inert = start <= 0.0 and end >= self.seconds
            self._note("reset", INERT if inert else UNSUPPORTED, text)

    def _enforce_particle_translation(self) -> None:
        self._box(
            self._vector("point"), self._vector("size"), self._number("start_time"),
            self._number("end_time"), self._vector("velocity"),
        )  # fmt: skip

    def _enforce_particle_velocity_rotation(self) -> None:
        normal = np.array(self._vector("normal"))
        if not normal.any():
            raise InputError(f"{self._place}normal must not be zero", "give an axis")
        normal /= np.linalg.norm(normal)
        half, radius = numbers(self._entry, "half_height_and_radius", [], self._place, 2)
        keys: dict[str, Any] = {}
        # their azimuth runs from h to h x n, which is the other way round about n
        spin = self.space.way(-self._number("rotation_scale") * normal)
        moved = self.space.way(self._number("translation_scale") * normal)
        keys |= {name: v for name, v in (("spin", spin), ("velocity", moved)) if any(v)}
        turn = turn_to(np.array(self.space.way(normal)))
        if any(turn):
            keys["turn"] = turn
        self._add(
            "cylinder", self._number("start_time"), self._number("end_time"),
            at=self.space.place(self._vector("point")), radius=radius, length=2.0 * half, **keys,
        )  # fmt: skip

    def _release_particles_sequentially(self) -> None:
        normal = self._vector("normal")
        axes = [i for i in range(3) if normal[i] != 0.0]
        if not axes:
            raise InputError(f"{self._place}normal must not be zero", "give an axis")
        if self._entry.get("num_layers") != LAYERS:
            self._note("num_layers", INERT, f"PhysGaussian always takes {LAYERS}")
        first, last = self._number("start_position"), self._number("end_position")
        start, end = self._number("start_time"), self._number("end_time")
        point, half = [1.0] * 3, [1.0] * 3
        for axis in axes:
            point[axis] = last
        for layer in range(LAYERS):
            half[axes[-1]] = abs(first - last) * (LAYERS - layer) / LAYERS
            begin, stop = (end * k / LAYERS for k in (layer, layer + 1))
            if stop > start:
                self._box(point, half, max(start, begin), stop, [0.0] * 3)

    def _surface_collider(self) -> None:
        normal = np.array(self._vector("normal"))
        if not normal.any():
            raise InputError(f"{self._place}normal must not be zero", "give an axis")
        surface, friction = self._entry["surface"], self._number("friction")
        if surface != "sticky":
            text = f"{surface} stops every node behind the plane in PhysGaussian: sticky here"
            self._note("surface", NEAR if surface in ("slip", "separate") else UNSUPPORTED, text)
        elif friction != 0.0:
            raise InputError(f"{self._place}friction must be 0 on a sticky surface", "set it to 0")
        if friction != 0.0:
            self._note("friction", INERT, "PhysGaussian stops every node behind the plane")
        start, end = self._number("start_time"), self._number("end_time")
        if start <= 0.0 and end >= self.seconds and self._is_floor(
            self._vector("point"), normal, {"floor_mode": "sticky"}
        ):  # fmt: skip
            return
        self._add("plane", start, end, at=self.space.place(self._vector("point")),
                  normal=self.space.way(normal / np.linalg.norm(normal)))  # fmt: skip

    def _bounding_box(self) -> None:
        width = number(self.values, "grid_lim", 2.0)
        wall = WALL_CELLS * width / number(self.values, "n_grid", 50.0)
        falls = self.space.way(numbers(self.values, "g", [0.0] * 3))[2] < 0.0
        for axis in range(3):
            for side in (1.0, -1.0):
                normal, point = np.zeros(3), [1.0] * 3
                normal[axis] = side
                point[axis] = wall if side > 0 else width - wall
                keys = {"floor_mode": "separate", "floor_friction": 0.0}
                if falls and self._is_floor(point, normal, keys):
                    continue
                self.colliders.append(
                    {"type": "plane", "mode": "separate", "friction": 0.0,
                     "at": self.space.place(point), "normal": self.space.way(normal)}
                )  # fmt: skip

    def _is_floor(self, point: list[float], normal: Array, keys: dict[str, Any]) -> bool:
        """Take an upward plane under the object as the floor of the shot, if it has none yet."""
        upward = self.space.upright @ (normal / np.linalg.norm(normal))
        height = float((self.space.upright @ (np.array(point) - 1.0))[2])
        if upward[2] < 1.0 - 1e-9 or self._lowest < height + ROOM:
            return False
        if self.floor is not None:
            return False
        self.floor, self.floor_keys = height, keys
        return True

    def _particle_impulse(self) -> None:
        half, point = np.array(self._vector("size")), np.array(self._vector("point"))
        chosen = (np.abs(self.points - point) < half).all(axis=1)
        start = self._number("start_time")
        if start > 0.0 or not chosen.all():
            what = f"start_time {start:g}" if start > 0.0 else f"{chosen.mean():.0%} of the points"
            text = f"only a push on all points at time 0 has a meaning here; this is {what}"
            self._note("force", UNSUPPORTED, text)
            return
        steps = self._number("num_dt", 1.0) * number(self.values, "substep_dt", 1e-4)
        force = np.array(self._vector("force"))
        speed = force * steps * float(chosen.sum()) / float(self.mass[chosen].sum())
        event = {"type": "throw", "velocity": self.space.way(speed)}
        self.events.append(event)
        text = f"throw at {math.hypot(*speed):.3g} m/s: all Gaussians' speeds, averaged by mass"
        if "particle_filling" in self.values:
            text += "; filled particles are not counted"
        self._note("force", NEAR, text)


def gaussian_masses(values: Mapping[str, Any], points: Array) -> Array:
    """Mass that PhysGaussian gives to each Gaussian [kg]: those of a cell share its volume, [N].

    Args:
        values: The config.
        points: Coordinates in its box, [N, 3].
    """
    cell = number(values, "grid_lim", 2.0) / number(values, "n_grid", 50.0)
    where = np.floor(points / cell).astype(np.int64)
    _, index, count = np.unique(where, axis=0, return_inverse=True, return_counts=True)
    volume = cell**3 / count[index.reshape(-1)]
    if values.get("material", "jelly") == "sand":
        volume = np.full_like(volume, volume.mean())
    density = np.full(len(points), number(values, "density", 200.0))
    for i, extra in enumerate(values.get("additional_material_params", [])):
        place = f"additional_material_params[{i}]."
        offset = np.abs(points - numbers(extra, "point", [], place))
        inside = (offset < numbers(extra, "size", [], place)).all(axis=1)
        density[inside] = number(extra, "density", number(values, "density", 200.0), place)
    return np.asarray(volume * density)
