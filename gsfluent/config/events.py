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


Event = Drop | Throw | Bullet | Blade | Press | Pour | Collide
EVENTS: dict[str, type[Event]] = {
    "drop": Drop,
    "throw": Throw,
    "bullet": Bullet,
    "blade": Blade,
    "press": Press,
    "pour": Pour,
    "collide": Collide,
}


def read_events(value: Any, place: Place) -> tuple[Event, ...]:
    """Read the list of events."""
    events: tuple[Event, ...] = typed(value, place, EVENTS, "event")
    for index, event in enumerate(events):
        if isinstance(event, Pour):
            either_of(event, ("volume", "duration"), Place(f"{place.path}[{index}]", place.folder))
    return events
