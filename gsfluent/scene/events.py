"""What happens to the bodies of a scene: drop, throw, collide, bullet, pour; and all events."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from gsfluent import materials
from gsfluent.errors import InputError
from gsfluent.materials import Material
from gsfluent.scene.grips import Grips
from gsfluent.scene.parts import (
    Body,
    Collider,
    Impulse,
    Vector,
    add,
    known_key,
    number,
    scaled,
    unit,
    vector,
)

EVENTS = ("drop", "throw", "bullet", "blade", "press", "pour", "collide", "grip", "pull",
          "twist", "bend")  # fmt: skip
_FILE_NAMES = {"from": "start"}  # keys of a shot file that cannot be names in Python


class Events(Grips):
    """The part of :class:`gsfluent.Scene` that places, moves and strikes its bodies."""

    floor: float | None
    gravity: Vector

    def drop(self, height: float, object: str | None = None) -> None:
        """Put a solid so that its lowest point is ``height`` metres above the floor (or z = 0).

        Args:
            height: Height [m], not negative.
            object: Name of the body; default: every solid.

        Raises:
            InputError: A negative height or an unknown body.
        """
        height = number("drop height", height, low=0.0)
        for index in self._targets(object):
            body = self.bodies[index]
            lowest = float(body.bounds()[0][2])
            self._shift(index, (0.0, 0.0, (self.floor or 0.0) + height - lowest))

    def lift(self, height: float) -> None:
        """Move all solids up together by ``height`` [m]."""
        for index in self._targets(None):
            self._shift(index, (0.0, 0.0, number("lift height", height)))

    def throw(
        self,
        velocity: Sequence[float],
        spin: Sequence[float] = (0.0, 0.0, 0.0),
        object: str | None = None,
        at: float = 0.0,
    ) -> None:
        """Give a solid a velocity and a spin about its centre of mass.

        At time 0 they are what the solid starts with. Later they are added to the motion of all its
        matter, broken off or not: an impulse of ``mass * velocity``.

        Args:
            velocity: [m/s], [3].
            spin: Angular velocity [rad/s], [3].
            object: Name of the body; default: every solid.
            at: When [s].

        Raises:
            InputError: A number out of range or an unknown body.
        """
        if number("throw at", at, low=0.0) > 0.0:
            self.impulse(velocity, spin, object, at)
            return
        moved, turned_ = vector("throw velocity", velocity), vector("throw spin", spin)
        for index in self._targets(object):
            self.bodies[index] = dataclasses.replace(
                self.bodies[index], velocity=moved, angular_velocity=turned_
            )

    def impulse(
        self, velocity: Sequence[float], spin: Sequence[float], object: str | None, at: float
    ) -> None:
        """Add to the motion of a solid at a time: what :meth:`throw` does after time 0."""
        push = Impulse(0, vector("throw velocity", velocity), vector("throw spin", spin), at)
        self.impulses += [dataclasses.replace(push, body=index) for index in self._targets(object)]

    def collide(
        self,
        objects: Sequence[str],
        speed: float,
        direction: Sequence[float] | None = None,
        distance: float | None = None,
    ) -> None:
        """Throw two solids at each other at time 0; their common centre of mass stays at rest.

        Masses are taken from volume and density of the whole object (not of its parts).

        Args:
            objects: Names of the two.
            speed: Relative speed [m/s].
            direction: From the first to the second, [3]; default: between their middles.
            distance: Move both along ``direction``, equally, until their boxes are this far apart
                in that direction [m]; default: they stay where they are.

        Raises:
            InputError: Not two different known bodies, or no direction between them.
        """
        if isinstance(objects, str) or len(objects) != 2 or objects[0] == objects[1]:
            raise InputError(
                f"collide: 'objects' must name two different objects, got {objects!r}",
                hint="give [first, second]",
            )
        speed = number("collide speed", speed, low=0.0)
        a, b = (self._targets(name)[0] for name in objects)
        boxes = [torch.stack(self.bodies[i].bounds()) for i in (a, b)]
        between = (boxes[1] - boxes[0]).mean(dim=0).tolist()
        if direction is None and math.hypot(*between) == 0.0:
            raise InputError("collide: both objects have the same middle", hint="give 'direction'")
        way = unit("collide direction", between if direction is None else direction)
        if distance is not None:
            gap = number("collide distance", distance, low=0.0)
            along = torch.tensor(way, dtype=torch.float64)
            # Farthest reach of each box along the line, from its middle.
            reach = sum(float((0.5 * (box[1] - box[0])) @ along.abs()) for box in boxes)
            apart = float(torch.tensor(between, dtype=torch.float64) @ along)
            half = 0.5 * (reach + gap - apart)
            for index, sign in ((a, -1.0), (b, 1.0)):
                self._shift(index, scaled(sign * half, way))
        weights = [self.bodies[i].volume * _density(self.bodies[i].material) for i in (a, b)]
        share = weights[1] / sum(weights)
        for index, part in ((a, share), (b, share - 1.0)):
            self.bodies[index] = dataclasses.replace(
                self.bodies[index], velocity=scaled(speed * part, way)
            )

    def bullet(
        self,
        start: Sequence[float],
        toward: Sequence[float],
        speed: float,
        radius: float = 0.008,
        density: float = 7800.0,
        at: float = 0.0,
        rigid: bool = False,
    ) -> str:
        """Fire a dense ball: elastic with its own velocity field, or rigid.

        The density is what is asked for. The stiffness of an elastic ball is not that of steel: it
        is chosen so that its wave speed equals that of the stiffest other body, so that the ball
        does not shorten the time step. It is still stiffer than its target by the ratio of
        densities, and so hardly deforms. A rigid ball does not deform at all; it exchanges momentum
        and spin with what it hits and cannot pass between grid nodes however fast it is.

        Args:
            start: Position [m] at time ``at``, [3].
            toward: Point it flies towards [m], [3].
            speed: Speed at time ``at`` [m/s].
            radius: Radius [m].
            density: Density [kg/m^3].
            at: Time [s] at which it leaves ``start``; before that it is not there.
            rigid: Whether it is rigid.

        Returns:
            The name of the new body or collider.

        Raises:
            InputError: No solid to hit yet, or ``toward`` equals ``start``.
        """
        solids = [body for body in self.bodies if body.solid is not None]
        if not solids:
            raise InputError("bullet: the scene has no solid to hit", hint="scene.add(...) first")
        origin, target = vector("bullet from", start), vector("bullet toward", toward)
        if math.dist(origin, target) == 0.0:
            raise InputError(
                "bullet: 'toward' must differ from 'from'", hint="aim at another point"
            )
        way = unit("bullet", [b - a for a, b in zip(origin, target, strict=True)])
        velocity = scaled(number("bullet speed", speed, low=0.0), way)
        density = number("bullet density", density, low=1.0)
        radius = number("bullet radius", radius, low=1e-6)
        at = number("bullet at", at, low=0.0)
        name = self._name(None, "bullet")
        if rigid:
            mass = 4.0 / 3.0 * math.pi * radius**3 * density
            self.colliders.append(
                Collider(
                    name, "sphere", origin, radius=radius, velocity=velocity, mass=mass, start=at
                )
            )
            return name
        stiffest = max(
            part.wave_speed
            for body in solids
            for part in [body.material, *(p.material(body.material) for p in body.parts)]
        )
        nu = 0.3
        young = density * stiffest**2 * (1 + nu) * (1 - 2 * nu) / (1 - nu)
        ball = Material(
            "bullet", young, nu, density, law="elastic",
            sources={"young_modulus": "derived: wave speed of the stiffest target"},
        )  # fmt: skip
        self.bodies.append(
            Body(
                name, ball, offset=origin, velocity=velocity, radius=radius, start=at, held=at > 0.0
            )
        )
        return name

    def pour(
        self,
        start: Sequence[float],
        speed: float,
        radius: float,
        direction: Sequence[float] = (0.0, 0.0, -1.0),
        volume: float | None = None,
        duration: float | None = None,
        material: Material | str = "water",
        at: float = 0.0,
    ) -> str:
        """Pour a liquid: a straight jet that leaves a nozzle at time ``at``.

        The jet is a cylinder of liquid behind the nozzle which moves with one velocity, in free
        flight, until it meets something. Its length is ``volume / (pi radius^2)``.

        Args:
            start: Middle of the nozzle [m], where the front of the jet is at time ``at``.
            speed: Speed at the nozzle [m/s].
            radius: Radius of the nozzle [m].
            direction: Where it flows, [3].
            volume: How much [m^3]; this or ``duration``.
            duration: How long it flows at ``speed`` [s].
            material: A material or the name of a preset.
            at: Time [s]; the jet waits until then.

        Returns:
            The name of the new body.

        Raises:
            InputError: Both or neither of ``volume`` and ``duration``, or a number out of range.
        """
        nozzle, way = vector("pour from", start), unit("pour direction", direction)
        speed = number("pour speed", speed, low=0.0)
        radius = number("pour radius", radius, low=1e-6)
        if (volume is None) == (duration is None):
            raise InputError("pour: give either 'volume' or 'duration'", hint="keep one of them")
        if volume is not None:
            length = number("pour volume", volume, low=1e-12) / (math.pi * radius**2)
        else:
            length = speed * number("pour duration", duration, low=1e-9)
        if length == 0.0:
            raise InputError("pour: nothing flows at speed 0", hint="give 'volume' or a speed")
        back = scaled(-0.5 * length, way)
        body = Body(
            name=self._name(None, "liquid"),
            material=materials.get(material) if isinstance(material, str) else material,
            offset=add(nozzle, back),
            velocity=scaled(speed, way),
            radius=radius,
            length=length,
            axis=way,
            start=number("pour at", at, low=0.0),
            held=True,
        )
        self.bodies.append(body)
        return body.name

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Apply one entry of a shot file's ``events``; its ``type`` is the name of a method.

        Raises:
            InputError: An unknown type or key, or a missing key.
        """
        rest = dict(event)
        kind = rest.pop("type", None)
        known_key("event type", kind, EVENTS)
        method = getattr(self, str(kind))
        parameters = inspect.signature(method).parameters
        file_names = {inner: outer for outer, inner in _FILE_NAMES.items()}
        keys = {file_names.get(name, name): name for name in parameters}
        for key in rest:
            known_key(f"event {kind!r}", key, tuple(keys))
        needed = [
            key for key, name in keys.items() if parameters[name].default is inspect.Parameter.empty
        ]
        for key in needed:
            if key not in rest:
                raise InputError(
                    f"event {kind!r}: {key!r} is missing", hint=f"required: {', '.join(needed)}"
                )
        method(**{keys[key]: value for key, value in rest.items()})


def _density(material: Material) -> float:
    """Density [kg/m^3], the mean of one that varies in space."""
    return float(torch.as_tensor(material.density, dtype=torch.float64).mean())
