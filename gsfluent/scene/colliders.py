"""Rigid things of a scene: colliders, presses, blades."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import torch

from gsfluent.errors import InputError
from gsfluent.scene.parts import (
    Blade,
    Body,
    Collider,
    Impulse,
    Vector,
    add,
    known_key,
    number,
    quaternion,
    quaternion_to,
    scaled,
    turned,
    unit,
    vector,
)

MODES = ("separate", "slip", "sticky")
SHAPES = ("plane", "sphere", "box", "capsule", "cylinder", "mesh")


class RigidThings:
    """What a scene holds, and the rigid things among it."""

    def __init__(self) -> None:
        self.bodies: list[Body] = []
        self.colliders: list[Collider] = []
        self.blades: list[Blade] = []
        self.impulses: list[Impulse] = []

    def press(
        self,
        speed: float,
        stroke: float,
        direction: Sequence[float] = (0.0, 0.0, -1.0),
        start: Sequence[float] | None = None,
        size: Sequence[float] | None = None,
        thickness: float | None = None,
        friction: float = 0.4,
        object: str | None = None,
        at: float = 0.0,
    ) -> str:
        """Press a rigid plate onto the objects; it stops after its stroke and stays there.

        Args:
            speed: Speed of the plate [m/s].
            stroke: How far it moves [m].
            direction: Where it moves, [3].
            start: Middle of its face at the start [m]; default: touching the object.
            size: Edges of the face [m], [2]; default: half as large again as the object.
            thickness: Of the plate [m]; default: a tenth of its longest edge.
            friction: Coulomb friction.
            object: The object that default place and size are taken from; default: all solids.
            at: When it starts to move [s].

        Returns:
            The name of the new collider.

        Raises:
            InputError: A number out of range or an unknown object.
        """
        way = unit("press direction", direction)
        speed = number("press speed", speed, low=1e-9)
        stroke = number("press stroke", stroke, low=0.0)
        at = number("press at", at, low=0.0)
        turn = quaternion_to(way)
        boxes = [torch.stack(self.bodies[i].bounds()) for i in self._targets(object)]
        low = torch.stack([box[0] for box in boxes]).amin(dim=0)
        high = torch.stack([box[1] for box in boxes]).amax(dim=0)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        along = torch.tensor(way, dtype=torch.float64)
        if start is None:
            face = add(middle.tolist(), scaled(-float(half @ along.abs()), way))
        else:
            face = vector("press from", start)
        if size is None:
            axes = [
                torch.tensor(turned(turn, axis), dtype=torch.float64)
                for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
            ]
            edges = [3.0 * float(half @ axis.abs()) for axis in axes]
        else:
            if isinstance(size, str) or len(size) != 2:
                raise InputError("press size must have two numbers", hint="give [width, depth]")
            edges = [number("press size", edge, low=1e-6) for edge in size]
        thick = 0.1 * max(edges) if thickness is None else number("thickness", thickness, low=1e-6)
        plate = Collider(
            name=self._name(None, "press"),
            kind="box",
            point=add(face, scaled(-0.5 * thick, way)),
            size=(edges[0], edges[1], thick),
            orientation=turn,
            friction=number("press friction", friction, low=0.0),
            velocity=scaled(speed, way),
            start=at,
            stop=at + stroke / speed,
            backed=True,
        )
        self.colliders.append(plate)
        return plate.name

    def blade(
        self,
        path: Sequence[Sequence[float]],
        width: float,
        thickness: float = 0.0,
        speed: float = 1.0,
        edge: Sequence[float] | None = None,
        at: float = 0.0,
    ) -> str:
        """Draw a straight edge through the scene; it parts what it passes.

        Args:
            path: Where the middle of the edge goes [m], two or more points.
            width: Length of the edge [m].
            thickness: How far the sides are pushed apart behind the edge [m]; 0 only parts them.
            speed: Of the edge along its path [m/s].
            edge: Direction of the edge, [3]; default: horizontal and across the path (y when the
                path is upright).
            at: When it starts [s].

        Returns:
            The name of the blade.

        Raises:
            InputError: Fewer than two points, a point twice in a row, or an edge along the path.
        """
        if isinstance(path, str) or not isinstance(path, Sequence) or len(path) < 2:
            raise InputError("blade: 'path' must have two or more points", hint="give [[x, y, z], "
                             "[x, y, z]]")  # fmt: skip
        points = tuple(vector("blade path", point) for point in path)
        legs = [add(b, scaled(-1.0, a)) for a, b in itertools.pairwise(points)]
        first = unit("blade: the first leg of 'path'", legs[0])
        if edge is None:
            flat = math.hypot(first[0], first[1]) < 1e-6
            line = (0.0, 1.0, 0.0) if flat else unit("edge", (-first[1], first[0], 0.0))
        else:
            line = unit("blade edge", edge)
        for leg in legs:
            way = unit("blade: a leg of 'path'", leg)
            if abs(sum(p * q for p, q in zip(way, line, strict=True))) > 0.95:
                raise InputError(
                    "blade: the edge must not lie along the path", hint="give another 'edge'"
                )
        knife = Blade(
            name=self._name(None, "blade"),
            path=points,
            edge=line,
            width=number("blade width", width, low=1e-6),
            thickness=number("blade thickness", thickness, low=0.0),
            speed=number("blade speed", speed, low=1e-9),
            start=number("blade at", at, low=0.0),
        )
        self.blades.append(knife)
        return knife.name

    def add_collider(
        self,
        shape: str,
        *,
        at: Sequence[float] = (0.0, 0.0, 0.0),
        normal: Sequence[float] = (0.0, 0.0, 1.0),
        radius: float = 0.0,
        size: Sequence[float] | None = None,
        length: float = 0.0,
        mesh: str | Path | None = None,
        scale: float = 1.0,
        turn: Sequence[float] = (0.0, 0.0, 0.0),
        mode: str = "separate",
        friction: float = 0.4,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        spin: Sequence[float] = (0.0, 0.0, 0.0),
        mass: float | None = None,
        appears: float = 0.0,
        vanishes: float | None = None,
        shown: bool = True,
        name: str | None = None,
    ) -> str:
        """Add a rigid thing that matter cannot enter.

        Args:
            shape: ``plane``, ``sphere``, ``box``, ``capsule``, ``cylinder`` or ``mesh``.
            at: Plane point or centre [m]; of a mesh: where its own origin goes.
            normal: Normal out of a plane.
            radius: Of sphere, capsule, cylinder; of a plane: 0 is endless, else of its disc [m].
            size: Edges of a box [m], [3].
            length: Of a cylinder, or between the centres of a capsule's caps [m].
            mesh: File that trimesh reads; it must be closed.
            scale: Metres per unit of the mesh file.
            turn: Rotation vector [degrees]: the axis it points along, by its length.
            mode: ``separate``, ``slip`` or ``sticky``.
            friction: Coulomb friction (``separate`` only).
            velocity: [m/s]; it moves so for ever.
            spin: Angular velocity [rad/s].
            mass: None: it moves as told. A number [kg]: it takes the impulse of what it hits and
                falls.
            appears: From when it is there, and moves [s].
            vanishes: Until when it is there [s]; None: for ever.
            shown: Whether it is drawn.
            name: Name; default: the shape.

        Returns:
            The name.

        Raises:
            InputError: An unknown shape or mode, a number out of range, or no such file.
        """
        known_key("collider shape", shape, SHAPES)
        known_key("collider mode", mode, MODES)
        where = f"collider {shape!r}"
        if shape in ("sphere", "capsule", "cylinder"):
            number(f"{where}: radius", radius, low=1e-9)
        if shape == "cylinder":
            number(f"{where}: length", length, low=1e-9)
        if shape == "box" and size is None:
            raise InputError(f"{where}: 'size' is missing", hint="give its edges [x, y, z]")
        if shape == "mesh" and (mesh is None or not Path(mesh).is_file()):
            raise InputError(f"{where}: no file {str(mesh)!r}", hint="give the mesh's file")
        if shape == "plane" and mass is not None:
            raise InputError(f"{where}: a plane has no mass", hint="use a box")
        appears = number(f"{where}: appears", appears, low=0.0)
        gone = math.inf if vanishes is None else number(f"{where}: vanishes", vanishes)
        if not gone > appears:
            raise InputError(f"{where}: it vanishes at {gone:g} s, before it appears at "
                             f"{appears:g} s", hint="let it vanish later")  # fmt: skip
        if mass is not None and (appears > 0.0 or math.isfinite(gone)):
            raise InputError(
                f"{where}: one with a mass is there all the time",
                hint="leave out its mass, or appears and vanishes",
            )
        edges = (0.0, 0.0, 0.0) if size is None else vector(f"{where}: size", size)
        for edge in edges if shape == "box" else ():
            number(f"{where}: size", edge, low=1e-9)
        self.colliders.append(
            Collider(
                name=self._name(name, shape),
                kind=shape,
                point=vector(f"{where}: at", at),
                normal=unit(f"{where}: normal", normal),
                radius=number(f"{where}: radius", radius, low=0.0),
                size=edges,
                length=number(f"{where}: length", length, low=0.0),
                mesh=None if mesh is None else Path(mesh),
                scale=number(f"{where}: scale", scale, low=1e-9),
                orientation=quaternion(f"{where}: turn", turn),
                mode=mode,
                friction=number(f"{where}: friction", friction, low=0.0),
                velocity=vector(f"{where}: velocity", velocity),
                angular_velocity=vector(f"{where}: spin", spin),
                mass=None if mass is None else number(f"{where}: mass", mass, low=1e-9),
                start=appears,
                stop=gone,
                appears=appears,
                vanishes=gone,
                shown=bool(shown),
            )
        )
        return self.colliders[-1].name

    def _shift(self, index: int, by: Vector) -> None:
        body = self.bodies[index]
        self.bodies[index] = dataclasses.replace(body, offset=add(body.offset, by))

    def _targets(self, name: str | None) -> list[int]:
        """Return the indices of the named body, or of every solid."""
        if name is not None:
            for index, body in enumerate(self.bodies):
                if body.name == name:
                    return [index]
            names = [body.name for body in self.bodies]
            raise InputError(
                f"event: no object is called {name!r}", hint=f"known: {', '.join(names) or 'none'}"
            )
        found = [index for index, body in enumerate(self.bodies) if body.solid is not None]
        if not found:
            raise InputError("event: the scene has no solid", hint="scene.add(...) before events")
        return found

    def _name(self, name: str | None, stem: str) -> str:
        taken = {body.name for body in self.bodies}
        taken |= {item.name for item in self.colliders} | {item.name for item in self.blades}
        if name is not None:
            if name in taken:
                raise InputError(
                    f"scene: two bodies are called {name!r}", hint="give each its own name"
                )
            return name
        number_ = 1
        while (free := stem if number_ == 1 else f"{stem}{number_}") in taken:
            number_ += 1
        return free
