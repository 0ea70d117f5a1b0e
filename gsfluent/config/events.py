"""Events of a shot."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from typing import Any

from gsfluent.config.read import (
    Place,
    either_of,
    flag,
    key,
    number,
    optional,
    preset,
    read_direction,
    several_of,
    text,
    typed,
    vector,
)

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Drop:
    """``type: drop`` - let an object fall."""

    height: float = key(
        number(0.0, 1e4), "Height of its lowest point above the floor at the start [m].", "1.0"
    )
    object: str | None = optional(text, "Which object; all when absent.", "melon")


@dataclasses.dataclass(frozen=True)
class Throw:
    """``type: throw`` - give an object a velocity."""

    velocity: Vector = key(vector(3), "Velocity [m/s].", "[2, 0, 1]")
    spin: Vector = key(
        vector(3),
        "Angular velocity about the centre of mass [rad/s].",
        "[0, 6, 0]",
        default=(0.0, 0.0, 0.0),
    )
    object: str | None = optional(text, "Which object; all when absent.", "melon")
    at: float = key(
        number(0.0),
        "When [s]; after the start the velocity is added to that of all its matter.",
        "0.5",
        default=0.0,
    )


@dataclasses.dataclass(frozen=True)
class Bullet:
    """``type: bullet`` - fire a dense ball."""

    start: Vector = key(vector(3), "Where it starts, at time `at` [m].", "[2, 0, 0.2]", name="from")
    toward: Vector = key(vector(3), "Point it flies towards [m].", "[0, 0, 0.1]")
    speed: float = key(number(above=0.0), "Speed [m/s].", "60")
    radius: float = key(number(above=0.0), "Radius [m].", "0.008", default=0.008)
    density: float = key(number(1.0), "Density [kg/m^3].", "7800", default=7800.0)
    at: float = key(number(0.0), "Time at which it leaves `from` [s].", "0.4", default=0.0)
    rigid: bool = key(
        flag,
        "Rigid instead of elastic: it does not deform and cannot slip between grid nodes.",
        "true",
        default=False,
    )


@dataclasses.dataclass(frozen=True)
class Blade:
    """``type: blade`` - an edge that parts what it passes."""

    path: tuple[Vector, ...] = key(
        several_of(vector(3), 2),
        "Points that the middle of the edge passes [m].",
        "[[0, 0, 0.4], [0, 0, 0]]",
    )
    width: float = key(number(above=0.0), "Length of the edge [m].", "0.3")
    thickness: float = key(
        number(0.0),
        "How far it pushes the sides apart [m]; 0 only parts them.",
        "0.002",
        default=0.0,
    )
    speed: float = key(number(above=0.0), "Speed along the path [m/s].", "1.0", default=1.0)
    edge: Vector | None = optional(
        read_direction,
        "Direction of the edge; horizontal and across the path when absent.",
        "[0, 1, 0]",
    )
    at: float = key(number(0.0), "When it starts [s].", "0.2", default=0.0)


@dataclasses.dataclass(frozen=True)
class Press:
    """``type: press`` - a rigid plate that moves onto the objects and stops."""

    speed: float = key(number(above=0.0), "Speed of the plate [m/s].", "0.5")
    stroke: float = key(number(0.0), "How far it moves [m].", "0.1")
    direction: Vector = key(
        read_direction, "Where it moves.", "[0, 0, -1]", default=(0.0, 0.0, -1.0)
    )
    start: Vector | None = optional(
        vector(3),
        "Middle of its face at the start [m]; touching the object when absent.",
        "[0, 0, 0.3]",
        name="from",
    )
    size: tuple[float, float] | None = optional(
        vector(2, 1e-6),
        "Edges of its face [m]; half as large again as the object when absent.",
        "[0.4, 0.4]",
    )
    thickness: float | None = optional(
        number(above=0.0), "Its thickness [m]; a tenth of its longest edge when absent.", "0.04"
    )
    friction: float = key(number(0.0), "Coulomb friction.", "0.4", default=0.4)
    object: str | None = optional(
        text, "Which object place and size are taken from; all when absent.", "melon"
    )
    at: float = key(number(0.0), "When it starts to move [s].", "0.2", default=0.0)


@dataclasses.dataclass(frozen=True)
class Pour:
    """``type: pour`` - a jet of liquid; ``volume`` or ``duration``."""

    start: Vector = key(vector(3), "Middle of the nozzle [m].", "[0, 0, 0.5]", name="from")
    speed: float = key(number(0.0), "Speed at the nozzle [m/s].", "1.0")
    radius: float = key(number(above=0.0), "Radius of the nozzle [m].", "0.02")
    direction: Vector = key(
        read_direction, "Where it flows.", "[0, 0, -1]", default=(0.0, 0.0, -1.0)
    )
    volume: float | None = optional(
        number(above=0.0), "How much [m^3]; this or duration.", "0.0005"
    )
    duration: float | None = optional(
        number(above=0.0), "How long it flows at that speed [s]; this or volume.", "0.4"
    )
    material: str = key(preset, "What flows: a preset.", "milk", default="water")
    at: float = key(number(0.0), "When it begins to flow [s].", "0.2", default=0.0)


@dataclasses.dataclass(frozen=True)
class Collide:
    """``type: collide`` - two objects thrown at each other."""

    objects: tuple[str, str] = key(
        several_of(text, 2, 2), "Names of the two objects.", "[melon, bowl]"
    )
    speed: float = key(number(0.0), "Relative speed [m/s].", "6")
    direction: Vector | None = optional(
        read_direction,
        "From the first to the second; between their middles when absent.",
        "[1, 0, 0]",
    )
    distance: float | None = optional(
        number(0.0),
        "How far apart they are put at the start [m]; as they stand when absent.",
        "0.2",
    )


@dataclasses.dataclass(frozen=True)
class Grip:
    """``type: grip`` - points that are held, or driven as one rigid body."""

    box: tuple[Vector, Vector] = key(
        several_of(vector(3), 2, 2),
        "Two corners of the box whose points are gripped, from the start [m].",
        "[[-0.1, -0.1, 0], [0.1, 0.1, 0.02]]",
    )
    displacement: Vector = key(
        vector(3), "How far they are moved [m].", "[0, 0, 0.01]", default=(0.0, 0.0, 0.0)
    )
    turn: Vector = key(
        vector(3),
        "How far they are turned: degrees about the axis that the numbers point along.",
        "[0, 0, 30]",
        default=(0.0, 0.0, 0.0),
    )
    about: Vector | None = optional(
        vector(3),
        "What they are turned about, and the moment is about [m]; their middle when absent.",
        "[0, 0, 0]",
    )
    duration: float | None = optional(
        number(above=0.0), "How long the way takes [s]; needed where there is one.", "0.5"
    )
    object: str | None = optional(text, "Whose points; all objects' when absent.", "bar")
    at: float = key(number(0.0), "When the way begins [s].", "0.2", default=0.0)
    until: float | None = optional(
        number(above=0.0), "When they are let go [s]; never when absent.", "1.5"
    )
    name: str | None = optional(text, "Its name in run.json.", "jaw")


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Ends:
    """What both ends of an object are gripped by."""

    duration: float = key(number(above=0.0), "How long that takes [s].", "0.5")
    depth: float | None = optional(
        number(above=0.0), "How deep both ends are gripped [m]; 15 % of the length when absent.",
        "0.02",
    )  # fmt: skip
    object: str | None = optional(text, "Which object; the only one when absent.", "bar")
    at: float = key(number(0.0), "When it begins [s].", "0.2", default=0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pull(_Ends):
    """``type: pull`` - hold one end of an object and move the other along the line between them."""

    distance: float = key(number(), "How far it is pulled [m]; pressed when negative.", "0.01")
    direction: Vector = key(
        read_direction,
        "From the end that is held to the one that is pulled: along x, y or z.",
        "[1, 0, 0]",
        default=(0.0, 0.0, 1.0),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Twist(_Ends):
    """``type: twist`` - hold one end of an object and turn the other about the line between."""

    angle: float = key(number(), "How far it is turned [degrees].", "30")
    axis: Vector = key(
        read_direction,
        "From the end that is held to the one that is turned: along x, y or z.",
        "[1, 0, 0]",
        default=(0.0, 0.0, 1.0),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bend(_Ends):
    """``type: bend`` - turn both ends of an object against each other."""

    angle: float = key(number(), "Angle between the ends, half of it each [degrees].", "20")
    axis: Vector = key(
        read_direction,
        "What the second end is turned about, the first against it.",
        "[0, 0, 1]",
        default=(0.0, 1.0, 0.0),
    )
    direction: Vector = key(
        read_direction,
        "From the first end to the second: along x, y or z, across `axis`.",
        "[0, 0, 1]",
        default=(1.0, 0.0, 0.0),
    )


Event = Drop | Throw | Bullet | Blade | Press | Pour | Collide | Grip | Pull | Twist | Bend
EVENTS: dict[str, type[Event]] = {
    "drop": Drop,
    "throw": Throw,
    "bullet": Bullet,
    "blade": Blade,
    "press": Press,
    "pour": Pour,
    "collide": Collide,
    "grip": Grip,
    "pull": Pull,
    "twist": Twist,
    "bend": Bend,
}


def read_events(value: Any, place: Place) -> tuple[Event, ...]:
    """Read the list of events."""
    events: tuple[Event, ...] = typed(value, place, EVENTS, "event")
    for index, event in enumerate(events):
        if isinstance(event, Pour):
            either_of(event, ("volume", "duration"), Place(f"{place.path}[{index}]", place.folder))
    return events
