"""Points that are held or driven along a path: grip, pull, twist, bend."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from gsfluent.errors import InputError
from gsfluent.scene.colliders import RigidThings
from gsfluent.scene.parts import Collider, Vector, add, number, scaled, unit, vector

DEPTH = 0.15
"""How deep an end is gripped, as a share of the length between both ends."""
_AROUND = 0.1
"""How far the box of an end goes on beyond the object, as a share of its length: no point is lost
to rounding."""


class Grips(RigidThings):
    """The part of :class:`gsfluent.Scene` that holds and drives points."""

    def grip(
        self,
        box: Sequence[Sequence[float]],
        displacement: Sequence[float] = (0.0, 0.0, 0.0),
        turn: Sequence[float] = (0.0, 0.0, 0.0),
        about: Sequence[float] | None = None,
        duration: float | None = None,
        object: str | None = None,
        at: float = 0.0,
        until: float | None = None,
        name: str | None = None,
    ) -> str:
        """Hold the points in a box, or drive them: as one rigid body, at constant speed.

        What is gripped is gripped from the start, and where it is then; the reaction of each grip
        is in every frame's ``stats`` and in run.json.

        Args:
            box: Two opposite corners [m].
            displacement: How far the points are moved [m], [3].
            turn: How far they are turned [degrees about the axis that it points along], [3].
            about: What they are turned about, and moments are about [m], [3]; it moves with
                ``displacement``. Default: their centre of mass.
            duration: How long the way takes [s]; needed where there is one.
            object: Name of the body whose points are gripped; default: every solid.
            at: When the way begins [s].
            until: When they are let go [s]; never when absent.
            name: Name; default ``grip``, ``grip2``, ...

        Returns:
            The name of the grip.

        Raises:
            InputError: A number out of range, a way without a duration, or an unknown object.
        """
        if isinstance(box, str) or not isinstance(box, Sequence) or len(box) != 2:
            raise InputError(
                "grip: 'box' must have two corners", hint="give [[x, y, z], [x, y, z]]"
            )
        a, b = (vector("grip box", corner) for corner in box)
        low = min(a[0], b[0]), min(a[1], b[1]), min(a[2], b[2])
        high = max(a[0], b[0]), max(a[1], b[1]), max(a[2], b[2])
        moved, turned = vector("grip displacement", displacement), vector("grip turn", turn)
        at = number("grip at", at, low=0.0)
        lasts = math.inf
        if duration is not None:
            lasts = number("grip duration", duration, low=1e-9)
        elif any(moved) or any(turned):
            raise InputError("grip: 'duration' is missing", hint="say how long the way takes [s]")
        gone = math.inf if until is None else number("grip until", until, low=1e-9)
        if gone < at:
            raise InputError(
                f"grip: lets go at {gone:g} s, before its way begins at {at:g} s",
                hint="let it go later",
            )
        middle = [0.5 * (p + q) for p, q in zip(low, high, strict=True)]
        targets = self._targets(object)
        self.colliders.append(
            Collider(
                name=self._name(name, "grip"),
                kind="grip",
                point=vector("grip about", middle if about is None else about),
                mode="sticky",
                velocity=scaled(1.0 / lasts, moved),
                angular_velocity=scaled(math.radians(1.0 / lasts), turned),
                start=at,
                stop=min(at + lasts, gone),
                vanishes=gone,
                shown=False,
                box=(low, high),
                of=tuple(self.bodies[i].name for i in targets),
                centred=about is None,
            )
        )
        return self.colliders[-1].name

    def pull(
        self,
        distance: float,
        duration: float,
        direction: Sequence[float] = (0.0, 0.0, 1.0),
        depth: float | None = None,
        object: str | None = None,
        at: float = 0.0,
    ) -> tuple[str, str]:
        """Hold one end of an object and pull the other; a negative distance presses.

        Args:
            distance: How far the end is moved [m].
            duration: How long that takes [s].
            direction: From the end that is held to the one that is pulled, [3].
            depth: How deep the ends are gripped [m]; default: 15 % of the length.
            object: Name of the body; default: the only solid.
            at: When it begins [s].

        Returns:
            The names of the grips: held, pulled.

        Raises:
            InputError: A number out of range or an unknown object.
        """
        way = unit("pull direction", direction)
        far = {"displacement": scaled(number("pull distance", distance), way)}
        return self._ends("pull", way, depth, object, at, {}, far, duration)

    def twist(
        self,
        angle: float,
        duration: float,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        depth: float | None = None,
        object: str | None = None,
        at: float = 0.0,
    ) -> tuple[str, str]:
        """Hold one end of an object and turn the other about the line between their middles.

        Args:
            angle: How far the end is turned [degrees].
            duration: How long that takes [s].
            axis: From the end that is held to the one that is turned, [3].
            depth: How deep the ends are gripped [m]; default: 15 % of the length.
            object: Name of the body; default: the only solid.
            at: When it begins [s].

        Returns:
            The names of the grips: held, turned.

        Raises:
            InputError: A number out of range or an unknown object.
        """
        way = unit("twist axis", axis)
        far = {"turn": scaled(number("twist angle", angle), way)}
        return self._ends("twist", way, depth, object, at, {}, far, duration)

    def bend(
        self,
        angle: float,
        duration: float,
        axis: Sequence[float] = (0.0, 1.0, 0.0),
        direction: Sequence[float] = (1.0, 0.0, 0.0),
        depth: float | None = None,
        object: str | None = None,
        at: float = 0.0,
    ) -> tuple[str, str]:
        """Turn both ends of an object against each other: the same moment everywhere between them.

        Args:
            angle: By how much they are turned against each other, each by half of it [degrees].
            duration: How long that takes [s].
            axis: What the second end is turned about, the first against it, [3].
            direction: From the first end to the second, across ``axis``, [3].
            depth: How deep the ends are gripped [m]; default: 15 % of the length.
            object: Name of the body; default: the only solid.
            at: When it begins [s].

        Returns:
            The names of the grips: first, second.

        Raises:
            InputError: A number out of range, an axis along the direction, or an unknown object.
        """
        way, about = unit("bend direction", direction), unit("bend axis", axis)
        if abs(sum(p * q for p, q in zip(way, about, strict=True))) > 1e-3:
            raise InputError("bend: 'axis' must lie across 'direction'", hint="mend one of them")
        half = 0.5 * number("bend angle", angle)
        near, far = ({"turn": scaled(sign * half, about)} for sign in (-1.0, 1.0))
        return self._ends("bend", way, depth, object, at, near, far, duration)

    def _ends(
        self,
        what: str,
        way: Vector,
        depth: float | None,
        object: str | None,
        at: float,
        near: dict[str, Any],
        far: dict[str, Any],
        duration: float,
    ) -> tuple[str, str]:
        """Grip both ends of an object along an axis of the scene."""
        axis = max(range(3), key=lambda i: abs(way[i]))
        if abs(way[axis]) < 1.0 - 1e-6:
            raise InputError(
                f"{what}: the ends must lie along x, y or z, got {[round(w, 3) for w in way]}",
                hint="give two grips with boxes of their own instead",
            )
        targets = self._targets(object)
        if len(targets) != 1:
            raise InputError(f"{what}: the scene has several objects", hint="name one: object")
        body = self.bodies[targets[0]]
        low, high = (corner.tolist() for corner in body.bounds())
        length = high[axis] - low[axis]
        deep = DEPTH * length if depth is None else number(f"{what} depth", depth, low=1e-9)
        if not deep < 0.5 * length:
            raise InputError(
                f"{what}: both ends are gripped {deep:g} m deep, and the object is {length:g} m "
                "long",
                hint="give a smaller depth",
            )
        pad = _AROUND * max(q - p for p, q in zip(low, high, strict=True))
        outer = [p - pad for p in low], [q + pad for q in high]
        names = []
        for side, path in ((-1.0, near), (1.0, far)):
            box = [list(outer[0]), list(outer[1])]
            if side * way[axis] > 0.0:
                box[0][axis] = high[axis] - deep
            else:
                box[1][axis] = low[axis] + deep
            end = self._name(None, what)
            lasts = duration if path else None
            names.append(self.grip(box, duration=lasts, object=body.name, at=at, name=end, **path))
        return names[0], names[1]

    def _shift(self, index: int, by: Vector) -> None:
        """Move a body, and with it what was to be gripped of it."""
        super()._shift(index, by)
        name = self.bodies[index].name
        for i, c in enumerate(self.colliders):
            if c.box is not None and c.of == (name,):
                box = add(c.box[0], by), add(c.box[1], by)
                self.colliders[i] = dataclasses.replace(c, box=box, point=add(c.point, by))
