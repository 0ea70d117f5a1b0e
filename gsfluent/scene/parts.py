"""What a scene is made of: parts of solids, bodies, rigid colliders, blades.

Coordinates are SI metres with +z up.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.data import Frame, Solid
from gsfluent.errors import InputError
from gsfluent.materials import Material

Vector = tuple[float, float, float]
_WHERE_KEYS = (
    "depth_below",
    "depth_above",
    "color_near",
    "tolerance",
    "box",
    "sphere",
    "mask",
    "labels",
    "label_image",
    "label",
    "region",
)


@dataclasses.dataclass(frozen=True)
class Part:
    """A region of a solid with parameters of its own.

    Args:
        name: Name for messages.
        where: Conditions that must all hold: ``depth_below`` / ``depth_above`` [m under the
            surface], ``color_near`` ([r, g, b] in 0..1, with ``tolerance``, default 0.15),
            ``box`` ([[x, y, z], [x, y, z]]) and ``sphere`` ([x, y, z, radius]) in scene metres
            before any event moves the solid, ``mask`` (folder of masks), ``labels`` (segmentation
            of the photographs) or ``label_image`` (picture, or pictures by axis) with ``label``
            (name or number), ``region`` (number in ``Solid.regions``). See docs/guide/regions.md.
        overrides: Material parameters of the region; ``material`` starts from another preset.
    """

    name: str
    where: Mapping[str, Any]
    overrides: Mapping[str, Any]

    @staticmethod
    def parse(value: Part | Mapping[str, Any]) -> Part:
        """Read a part from the mapping of a shot file: ``name``, ``where`` and material parameters.

        Raises:
            InputError: ``where`` is missing, a key is unknown, or one holds for a whole object.
        """
        if isinstance(value, Part):
            return value
        rest = dict(value)
        name = str(rest.pop("name", "part"))
        where = rest.pop("where", None)
        if not isinstance(where, Mapping) or not where:
            raise InputError(
                f"part {name!r}: 'where' must name at least one condition, got {where!r}",
                hint=f"give one of: {', '.join(_WHERE_KEYS)}",
            )
        for key in where:
            known_key(f"part {name!r}, where", key, _WHERE_KEYS)
        sources = [key for key in ("mask", "labels", "label_image") if key in where]
        if len(sources) > 1:
            raise InputError(
                f"part {name!r}: 'where' has both {sources[0]} and {sources[1]}",
                hint="keep one of them, or make two parts",
            )
        for key in rest:
            if key in materials.WHOLE:
                raise InputError(
                    f"part {name!r}: {key} holds for a whole object",
                    hint=f"give {key} to the material of the object",
                )
            looks = (*materials.LOOKS, *materials.SCATTER)
            known_key(
                f"part {name!r}", key, (*materials.PARAMETERS, *looks, *materials.WORDS, "material")
            )
        return Part(name, dict(where), rest)

    def material(self, base: Material) -> Material:
        """Return the material of the region, given the one around it."""
        changes = dict(self.overrides)
        start = changes.pop("material", None)
        whole = base if start is None else materials.get(start) if isinstance(start, str) else start
        if start is None and "young_modulus" in changes:  # as much softer as what is around it
            changes = {"softening": base.softening, **changes}
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
        radius: Radius [m] when there is no solid: a ball, or a cylinder when ``length`` is given.
        length: Length of the cylinder [m].
        axis: Unit vector along the cylinder, [3].
        start: Time [s] at which the body passes ``offset`` with ``velocity``; before that it is
            on its way, in free flight.
        held: Instead of being on its way before ``start``, it waits at ``offset``.
        temperature: At time 0 [degrees C]; None: heat plays no part for it.
    """

    name: str
    material: Material
    solid: Solid | None = None
    frame: Frame = dataclasses.field(default_factory=Frame.identity)
    parts: tuple[Part, ...] = ()
    offset: Vector = (0.0, 0.0, 0.0)
    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    radius: float = 0.0
    length: float = 0.0
    axis: Vector = (0.0, 0.0, 1.0)
    start: float = 0.0
    held: bool = False
    temperature: float | None = None

    @property
    def volume(self) -> float:
        """Volume of the matter [m^3]."""
        if self.solid is not None:
            return self.solid.volume * self.frame.scale**3
        if self.length > 0.0:
            return math.pi * self.radius**2 * self.length
        return 4.0 / 3.0 * math.pi * self.radius**3

    @property
    def materials(self) -> tuple[Material, ...]:
        """Its material and those of its parts."""
        return (self.material, *(part.material(self.material) for part in self.parts))

    @functools.cached_property
    def breaking_speed(self) -> float:
        """Speed of the slowest strike that starts to break its weakest part [m/s], or infinity."""
        return min(material.breaking_speed for material in self.materials)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lowest and highest scene coordinates of the matter [m], each float64 [3]."""
        offset = torch.tensor(self.offset, dtype=torch.float64)
        if self.solid is None:
            axis = torch.tensor(self.axis, dtype=torch.float64)
            # A disc across the axis reaches radius * sqrt(1 - a_i^2) along coordinate i.
            across = (1.0 - axis**2).clamp(min=0.0).sqrt() if self.length > 0.0 else 1.0
            reach = self.radius * across + 0.5 * self.length * axis.abs()
            return offset - reach, offset + reach
        index = self.solid.occupancy.nonzero()
        corners = self.frame.apply(self.solid.voxel_centers(index).to(torch.float64).cpu()) + offset
        half = 0.5 * self.solid.voxel * self.frame.scale
        return corners.amin(dim=0) - half, corners.amax(dim=0) + half


@dataclasses.dataclass(frozen=True)
class Collider:
    """A rigid thing that matter cannot enter: standing, moved as told, or free (``mass``).

    Args:
        name: Unique name.
        kind: ``plane``, ``sphere``, ``box``, ``capsule``, ``cylinder``, ``mesh`` or ``grip``.
        point: Plane point or centre [m] at time ``start``; of a mesh: where its own origin is.
        normal: Normal out of a plane.
        radius: Of sphere, capsule, cylinder; of a plane: 0, or that of its disc [m].
        size: Edges of a box [m], [3].
        length: Of a cylinder, or between the centres of a capsule's caps [m]; along its own z.
        mesh: File that trimesh reads.
        scale: Metres per unit of the mesh file.
        orientation: Quaternion w, x, y, z, own frame to scene.
        mode: ``sticky``, ``slip`` or ``separate``.
        friction: Coulomb friction.
        velocity: Of the point from ``start`` to ``stop`` [m/s].
        angular_velocity: From ``start`` to ``stop`` [rad/s].
        mass: None: it moves as told and nothing stops it. A number: it takes the impulse of what
            it hits [kg]; it passes ``point`` at ``start``; before that it is not there.
        start: When it begins to move [s].
        stop: When it stands still [s].
        backed: A box that meets matter with its face (own +z) only: the grid may see it thicker
            behind.
        appears: From when it is there [s].
        vanishes: Until when it is there [s].
        shown: Whether it is drawn.
        box: Of a grip: two corners [m]; it is grown from the points between them at the start.
        of: Of a grip: names of the bodies whose points those are.
        centred: Of a grip: ``point`` is the centre of mass of its points.
    """

    name: str
    kind: str
    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    radius: float = 0.0
    size: Vector = (0.0, 0.0, 0.0)
    length: float = 0.0
    mesh: Path | None = None
    scale: float = 1.0
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    mode: str = "separate"
    friction: float = 0.4
    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    mass: float | None = None
    start: float = 0.0
    stop: float = math.inf
    backed: bool = False
    appears: float = 0.0
    vanishes: float = math.inf
    shown: bool = True
    box: tuple[Vector, Vector] | None = None
    of: tuple[str, ...] = ()
    centred: bool = False

    def there(self, time: float) -> bool:
        """Whether it is there at a time [s]."""
        return self.appears <= time < self.vanishes


@dataclasses.dataclass(frozen=True)
class Blade:
    """A straight edge that moves along a polyline and parts what it passes.

    Args:
        name: Unique name.
        path: Where the middle of the edge goes, [m], at least two points.
        edge: Unit vector along the edge.
        width: Length of the edge [m].
        thickness: How far the sides are pushed apart behind it [m]; 0 only parts them.
        speed: Of the edge along the path [m/s].
        start: When it starts [s].
    """

    name: str
    path: tuple[Vector, ...]
    edge: Vector
    width: float
    thickness: float
    speed: float
    start: float = 0.0


@dataclasses.dataclass(frozen=True)
class Impulse:
    """A velocity given to all matter of a body at a moment after the start.

    Args:
        body: Number of the body.
        velocity: Added to the velocity of every point [m/s], [3].
        spin: Angular velocity about the centre of mass that is added [rad/s], [3].
        start: When [s].
    """

    body: int
    velocity: Vector
    spin: Vector
    start: float


def known_key(where: str, key: Any, known: Any) -> None:
    """Refuse an unknown key, naming the nearest known one."""
    if key not in known:
        close = difflib.get_close_matches(str(key), list(known), n=1, cutoff=0.4)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise InputError(f"{where}: unknown {key!r}", hint=f"{hint}known: {', '.join(known)}")


def number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """Read a finite number in a range."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} must be a finite number, got {value!r}", hint="give one number")
    if not low <= value <= high:
        raise InputError(
            f"{name} must lie in [{low:g}, {high:g}], got {value:g}", hint="mend the number"
        )
    return float(value)


def vector(name: str, value: Any) -> Vector:
    """Read three numbers."""
    values = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != 3:
        raise InputError(f"{name} must have three components, got {value!r}", hint="give [x, y, z]")
    x, y, z = (number(name, part) for part in values)
    return x, y, z


def unit(name: str, value: Any) -> Vector:
    """Read a direction; any length but 0."""
    given = vector(name, value)
    length = math.hypot(*given)
    if length == 0.0:
        raise InputError(f"{name} must not be zero", hint="give a direction [x, y, z]")
    x, y, z = (part / length for part in given)
    return x, y, z


def quaternion(name: str, degrees: Any) -> tuple[float, float, float, float]:
    """Quaternion w, x, y, z of a rotation vector [degrees about the axis it points along]."""
    given = vector(name, degrees)
    angle = math.hypot(*given)
    if angle == 0.0:
        return 1.0, 0.0, 0.0, 0.0
    half = math.radians(0.5 * angle)
    x, y, z = (part / angle * math.sin(half) for part in given)
    return math.cos(half), x, y, z


def quaternion_to(direction: Vector) -> tuple[float, float, float, float]:
    """Quaternion w, x, y, z of the shortest turn that brings +z to a unit vector."""
    x, y, z = direction
    if z < -1.0 + 1e-12:
        return 0.0, 1.0, 0.0, 0.0
    w = math.sqrt(0.5 * (1.0 + z))
    return w, -y / (2.0 * w), x / (2.0 * w), 0.0


def add(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def scaled(factor: float, a: Sequence[float]) -> Vector:
    """Multiple of a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


def turned(q: tuple[float, float, float, float], v: Vector) -> Vector:
    """Turn a vector by a unit quaternion w, x, y, z."""
    w, x, y, z = q
    t = (2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0]))
    return (
        v[0] + w * t[0] + y * t[2] - z * t[1],
        v[1] + w * t[1] + z * t[0] - x * t[2],
        v[2] + w * t[2] + x * t[1] - y * t[0],
    )
