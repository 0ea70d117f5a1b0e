"""A scene: solids, what they are made of, where they are, how they move, and the floor.

Coordinates are SI metres with +z up. A solid is brought from its own (world) coordinates into the
scene by its ``Frame``; events then place and move it.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.data import Frame, Solid
from gsfluent.errors import InputError
from gsfluent.materials import Material

LATER_EVENTS = ("blade", "press", "pour", "collide")
_EVENT_KEYS: dict[str, tuple[str, ...]] = {
    "drop": ("height", "object"),
    "throw": ("velocity", "spin", "object"),
    "bullet": ("at", "from", "toward", "speed", "radius", "density"),
}
_WHERE_KEYS = ("depth_below", "depth_above", "color_near", "tolerance", "box", "sphere", "region")


@dataclasses.dataclass(frozen=True)
class Part:
    """A region of a solid with parameters of its own.

    Args:
        name: Name for messages.
        where: Conditions that must all hold: ``depth_below`` / ``depth_above`` [m under the
            surface], ``color_near`` ([r, g, b] in 0..1, with ``tolerance``, default 0.15),
            ``box`` ([[x, y, z], [x, y, z]]) and ``sphere`` ([x, y, z, radius]) in scene metres
            before any event moves the solid, ``region`` (number in ``Solid.regions``).
        overrides: Material parameters of the region; ``material`` starts from another preset.
    """

    name: str
    where: Mapping[str, Any]
    overrides: Mapping[str, Any]

    @staticmethod
    def parse(value: Part | Mapping[str, Any]) -> Part:
        """Read a part from the mapping of a shot file: ``name``, ``where`` and material parameters.

        Raises:
            InputError: ``where`` is missing or has an unknown key.
        """
        if isinstance(value, Part):
            return value
        rest = dict(value)
        name = str(rest.pop("name", "part"))
        where = rest.pop("where", None)
        if not isinstance(where, Mapping) or not where:
            raise InputError(
                f"part {name!r}: 'where' must name at least one condition, got {where!r}",
                mend=f"give one of: {', '.join(_WHERE_KEYS)}",
            )
        for key in where:
            _known(f"part {name!r}, where", key, _WHERE_KEYS)
        for key in rest:
            _known(
                f"part {name!r}",
                key,
                [
                    *materials.PARAMETERS,
                    *materials.LATER_FIELDS,
                    "variation",
                    "grain",
                    "material",
                    "law",
                ],
            )
        return Part(name, dict(where), rest)

    def material(self, base: Material) -> Material:
        """Return the material of the region, given the one around it."""
        changes = dict(self.overrides)
        start = changes.pop("material", None)
        whole = base if start is None else materials.get(start) if isinstance(start, str) else start
        return whole.override(name=f"{base.name}/{self.name}", **changes)


@dataclasses.dataclass(frozen=True)
class Body:
    """One object of a scene, at rest where its frame and ``offset`` put it.

    Args:
        name: Unique name.
        material: Its material (with per-part changes in ``parts``).
        solid: The filled object, or None for a plain sphere (a bullet).
        frame: World to scene.
        parts: Regions with parameters of their own; a later part wins where two overlap.
        offset: Translation added after ``frame`` [m], [3].
        velocity: Velocity of the centre of mass [m/s], [3].
        angular_velocity: Spin about the centre of mass [rad/s], [3].
        radius: Radius [m] when there is no solid.
        start: Time [s] at which the body passes ``offset`` with ``velocity``; before that it is
            on its way, in free flight.
    """

    name: str
    material: Material
    solid: Solid | None = None
    frame: Frame = dataclasses.field(default_factory=Frame.identity)
    parts: tuple[Part, ...] = ()
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    start: float = 0.0

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lowest and highest scene coordinates of the matter [m], each float64 [3]."""
        offset = torch.tensor(self.offset, dtype=torch.float64)
        if self.solid is None:
            return offset - self.radius, offset + self.radius
        index = self.solid.occupancy.nonzero()
        corners = self.frame.apply(self.solid.voxel_centers(index).to(torch.float64).cpu()) + offset
        half = 0.5 * self.solid.voxel * self.frame.scale
        return corners.amin(dim=0) - half, corners.amax(dim=0) + half


class Scene:
    """What is simulated: bodies, the floor, gravity.

    Args:
        floor: Height of the floor [m], or None for no floor.
        gravity: Acceleration [m/s^2], [3].
        floor_friction: Coulomb friction of the floor.
        friction: Coulomb friction between bodies.
        restitution: Restitution of node contact between bodies; elasticity adds its own bounce.
    """

    def __init__(
        self,
        floor: float | None = 0.0,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        *,
        floor_friction: float = 0.4,
        friction: float = 0.3,
        restitution: float = 0.0,
    ) -> None:
        self.floor = None if floor is None else _number("floor", floor)
        self.gravity = _vector("gravity", gravity)
        self.floor_friction = _number("floor_friction", floor_friction, low=0.0)
        self.friction = _number("friction", friction, low=0.0)
        self.restitution = _number("restitution", restitution, low=0.0, high=1.0)
        self.bodies: list[Body] = []

    def add(
        self,
        solid: Solid,
        material: Material | str = "fruit.watermelon",
        *,
        frame: Frame | None = None,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        parts: Sequence[Part | Mapping[str, Any]] | None = None,
        name: str | None = None,
    ) -> str:
        """Add a filled object where its frame puts it; events move it.

        Args:
            solid: The filled object.
            material: A :class:`Material` or the name of a preset.
            frame: World to scene; default: ``solid.frame``. Without either the solid stays where
                it is, but is lifted onto the floor when it starts below it.
            velocity: Velocity of the centre of mass at time 0 [m/s].
            angular_velocity: Spin about the centre of mass at time 0 [rad/s].
            parts: Regions with parameters of their own; default: those of the material.
            name: Name of the body; default ``object``, ``object2``, ...

        Returns:
            The name of the body.

        Raises:
            InputError: An empty solid, an unknown preset or parameter, or a name taken twice.
        """
        if not bool(solid.occupancy.any()):
            raise InputError(
                "scene.add: the solid holds no matter", mend="fill it first (gsfluent fill)"
            )
        chosen = materials.get(material) if isinstance(material, str) else material
        regions = tuple(Part.parse(part) for part in (chosen.parts if parts is None else parts))
        for part in regions:
            part.material(
                chosen
            )  # refuse bad parameters here, where the user can see which call is meant
        placed = frame or solid.frame
        body = Body(
            name=self._name(name, "object"),
            material=chosen,
            solid=solid,
            frame=placed or Frame.identity(),
            parts=regions,
            velocity=_vector("velocity", velocity),
            angular_velocity=_vector("angular_velocity", angular_velocity),
        )
        if placed is None and self.floor is not None:
            rise = self.floor - float(body.bounds()[0][2])
            body = dataclasses.replace(body, offset=(0.0, 0.0, max(rise, 0.0)))
        self.bodies.append(body)
        return body.name

    def drop(self, height: float, object: str | None = None) -> None:
        """Put a solid so that its lowest point is ``height`` metres above the floor (or z = 0).

        Args:
            height: Height [m], not negative.
            object: Name of the body; default: every solid.

        Raises:
            InputError: A negative height or an unknown body.
        """
        height = _number("drop height", height, low=0.0)
        for index in self._targets(object):
            body = self.bodies[index]
            lowest = float(body.bounds()[0][2])
            rise = (self.floor or 0.0) + height - lowest
            x, y, z = body.offset
            self.bodies[index] = dataclasses.replace(body, offset=(x, y, z + rise))

    def throw(
        self,
        velocity: Sequence[float],
        spin: Sequence[float] = (0.0, 0.0, 0.0),
        object: str | None = None,
    ) -> None:
        """Give a solid a velocity [m/s] and a spin [rad/s] about its centre of mass at time 0."""
        for index in self._targets(object):
            self.bodies[index] = dataclasses.replace(
                self.bodies[index],
                velocity=_vector("throw velocity", velocity),
                angular_velocity=_vector("throw spin", spin),
            )

    def bullet(
        self,
        start: Sequence[float],
        toward: Sequence[float],
        speed: float,
        radius: float = 0.008,
        density: float = 7800.0,
        at: float = 0.0,
    ) -> str:
        """Fire a dense elastic ball, a body with its own velocity field.

        Its density is what is asked for. Its stiffness is not that of steel: it is chosen so that
        its wave speed equals that of the stiffest other body, so that the ball does not shorten
        the time step. It is still stiffer than its target by the ratio of densities, and so
        hardly deforms.

        Args:
            start: Position [m] at time ``at``, [3].
            toward: Point it flies towards [m], [3].
            speed: Speed at time ``at`` [m/s].
            radius: Radius [m].
            density: Density [kg/m^3].
            at: Time [s] at which it passes ``start``; before that it is in free flight on its way
                there.

        Returns:
            The name of the new body.

        Raises:
            InputError: No solid to hit yet, or ``toward`` equals ``start``.
        """
        solids = [body for body in self.bodies if body.solid is not None]
        if not solids:
            raise InputError("bullet: the scene has no solid to hit", mend="scene.add(...) first")
        origin, target = _vector("bullet from", start), _vector("bullet toward", toward)
        distance = math.dist(origin, target)
        if distance == 0.0:
            raise InputError(
                "bullet: 'toward' must differ from 'from'", mend="aim at another point"
            )
        speed = _number("bullet speed", speed, low=0.0)
        density = _number("bullet density", density, low=1.0)
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
        heading = [(b - a) / distance * speed for a, b in zip(origin, target, strict=True)]
        body = Body(
            name=self._name(None, "bullet"),
            material=ball,
            offset=origin,
            velocity=(heading[0], heading[1], heading[2]),
            radius=_number("bullet radius", radius, low=1e-6),
            start=_number("bullet at", at, low=0.0),
        )
        self.bodies.append(body)
        return body.name

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Apply one entry of a shot file's ``events``: ``drop``, ``throw`` or ``bullet``.

        Raises:
            InputError: An unknown type or key, a missing key, or a type that arrives with a later
                issue.
        """
        rest = dict(event)
        kind = rest.pop("type", None)
        if kind in LATER_EVENTS:
            raise InputError(
                f"event {kind!r} is not in gsfluent yet; it arrives with a later issue",
                mend="use drop, throw or bullet",
            )
        _known("event type", kind, _EVENT_KEYS)
        for key in rest:
            _known(f"event {kind!r}", key, _EVENT_KEYS[kind])
        required = {
            "drop": ("height",),
            "throw": ("velocity",),
            "bullet": ("from", "toward", "speed"),
        }[kind]
        for key in required:
            if key not in rest:
                raise InputError(
                    f"event {kind!r}: {key!r} is missing", mend=f"required: {', '.join(required)}"
                )
        if kind == "drop":
            self.drop(**rest)
        elif kind == "throw":
            self.throw(**rest)
        else:
            self.bullet(start=rest.pop("from"), **rest)

    def _targets(self, name: str | None) -> list[int]:
        """Return the indices of the named body, or of every solid."""
        if name is not None:
            for index, body in enumerate(self.bodies):
                if body.name == name:
                    return [index]
            names = [body.name for body in self.bodies]
            raise InputError(
                f"event: no object is called {name!r}", mend=f"known: {', '.join(names) or 'none'}"
            )
        found = [index for index, body in enumerate(self.bodies) if body.solid is not None]
        if not found:
            raise InputError("event: the scene has no solid", mend="scene.add(...) before events")
        return found

    def _name(self, name: str | None, stem: str) -> str:
        taken = {body.name for body in self.bodies}
        if name is not None:
            if name in taken:
                raise InputError(
                    f"scene: two bodies are called {name!r}", mend="give each its own name"
                )
            return name
        number = 1
        while (free := stem if number == 1 else f"{stem}{number}") in taken:
            number += 1
        return free


def _known(where: str, key: Any, known: Any) -> None:
    """Refuse an unknown key, naming the nearest known one."""
    if key not in known:
        close = difflib.get_close_matches(str(key), list(known), n=1, cutoff=0.4)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise InputError(f"{where}: unknown {key!r}", mend=f"{hint}known: {', '.join(known)}")


def _number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} must be a finite number, got {value!r}", mend="give one number")
    if not low <= value <= high:
        raise InputError(
            f"{name} must lie in [{low:g}, {high:g}], got {value:g}", mend="mend the number"
        )
    return float(value)


def _vector(name: str, value: Any) -> tuple[float, float, float]:
    values = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != 3:
        raise InputError(f"{name} must have three components, got {value!r}", mend="give [x, y, z]")
    x, y, z = (_number(name, part) for part in values)
    return x, y, z
