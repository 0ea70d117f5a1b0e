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
    plain,
    preset,
    read_direction,
    several_of,
    text,
    typed,
    vector,
    without_none,
)

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Drop:
    """``type: drop`` - let an object fall."""

    height: float = key(
        number(0.0, 1e4),
        doc="Height of its lowest point above the floor at the start [m].",
        example="1.0",
    )
    object: str | None = key(
        text, default=None, doc="Which object; all when absent.", example="melon"
    )


@dataclasses.dataclass(frozen=True)
class Throw:
    """``type: throw`` - give an object a velocity."""

    velocity: Vector = key(vector(3), doc="Velocity [m/s].", example="[2, 0, 1]")
    spin: Vector = key(
        vector(3),
        default=(0.0, 0.0, 0.0),
        doc="Angular velocity about the centre of mass [rad/s].",
        example="[0, 6, 0]",
    )
    object: str | None = key(
        text, default=None, doc="Which object; all when absent.", example="melon"
    )
    at: float = key(
        number(0.0),
        default=0.0,
        doc="When [s]; after the start the velocity is added to that of all its matter.",
        example="0.5",
    )


@dataclasses.dataclass(frozen=True)
class Bullet:
    """``type: bullet`` - fire a dense ball."""

    start: Vector = key(
        vector(3), name="from", doc="Where it starts, at time `at` [m].", example="[2, 0, 0.2]"
    )
    toward: Vector = key(vector(3), doc="Point it flies towards [m].", example="[0, 0, 0.1]")
    speed: float = key(number(above=0.0), doc="Speed [m/s].", example="60")
    radius: float = key(number(above=0.0), default=0.008, doc="Radius [m].", example="0.008")
    density: float = key(number(1.0), default=7800.0, doc="Density [kg/m^3].", example="7800")
    at: float = key(
        number(0.0), default=0.0, doc="Time at which it leaves `from` [s].", example="0.4"
    )
    rigid: bool = key(
        flag,
        default=False,
        doc="Rigid instead of elastic: it does not deform and cannot slip between grid nodes.",
        example="true",
    )


@dataclasses.dataclass(frozen=True)
class Blade:
    """``type: blade`` - an edge that parts what it passes."""

    path: tuple[Vector, ...] = key(
        several_of(vector(3), 2),
        doc="Points that the middle of the edge passes [m].",
        example="[[0, 0, 0.4], [0, 0, 0]]",
    )
    width: float = key(number(above=0.0), doc="Length of the edge [m].", example="0.3")
    thickness: float = key(
        number(0.0),
        default=0.0,
        doc="How far it pushes the sides apart [m]; 0 only parts them.",
        example="0.002",
    )
    speed: float = key(
        number(above=0.0), default=1.0, doc="Speed along the path [m/s].", example="1.0"
    )
    edge: Vector | None = key(
        read_direction,
        default=None,
        doc="Direction of the edge; horizontal and across the path when absent.",
        example="[0, 1, 0]",
    )
    at: float = key(number(0.0), default=0.0, doc="When it starts [s].", example="0.2")


@dataclasses.dataclass(frozen=True)
class Press:
    """``type: press`` - a rigid plate that moves onto the objects and stops."""

    speed: float = key(number(above=0.0), doc="Speed of the plate [m/s].", example="0.5")
    stroke: float = key(number(0.0), doc="How far it moves [m].", example="0.1")
    direction: Vector = key(
        read_direction, default=(0.0, 0.0, -1.0), doc="Where it moves.", example="[0, 0, -1]"
    )
    start: Vector | None = key(
        vector(3),
        name="from",
        default=None,
        doc="Middle of its face at the start [m]; touching the object when absent.",
        example="[0, 0, 0.3]",
    )
    size: tuple[float, float] | None = key(
        vector(2, 1e-6),
        default=None,
        doc="Edges of its face [m]; half as large again as the object when absent.",
        example="[0.4, 0.4]",
    )
    thickness: float | None = key(
        number(above=0.0),
        default=None,
        doc="Its thickness [m]; a tenth of its longest edge when absent.",
        example="0.04",
    )
    friction: float = key(number(0.0), default=0.4, doc="Coulomb friction.", example="0.4")
    object: str | None = key(
        text,
        default=None,
        doc="Which object place and size are taken from; all when absent.",
        example="melon",
    )
    at: float = key(number(0.0), default=0.0, doc="When it starts to move [s].", example="0.2")


@dataclasses.dataclass(frozen=True)
class Pour:
    """``type: pour`` - a jet of liquid; ``volume`` or ``duration``."""

    start: Vector = key(
        vector(3), name="from", doc="Middle of the nozzle [m].", example="[0, 0, 0.5]"
    )
    speed: float = key(number(0.0), doc="Speed at the nozzle [m/s].", example="1.0")
    radius: float = key(number(above=0.0), doc="Radius of the nozzle [m].", example="0.02")
    direction: Vector = key(
        read_direction, default=(0.0, 0.0, -1.0), doc="Where it flows.", example="[0, 0, -1]"
    )
    volume: float | None = key(
        number(above=0.0),
        default=None,
        doc="How much [m^3]; this or duration.",
        example="0.0005",
    )
    duration: float | None = key(
        number(above=0.0),
        default=None,
        doc="How long it flows at that speed [s]; this or volume.",
        example="0.4",
    )
    material: str = key(preset, default="water", doc="What flows: a preset.", example="milk")
    at: float = key(number(0.0), default=0.0, doc="When it begins to flow [s].", example="0.2")


@dataclasses.dataclass(frozen=True)
class Collide:
    """``type: collide`` - two objects thrown at each other."""

    objects: tuple[str, str] = key(
        several_of(text, 2, 2), doc="Names of the two objects.", example="[melon, bowl]"
    )
    speed: float = key(number(0.0), doc="Relative speed [m/s].", example="6")
    direction: Vector | None = key(
        read_direction,
        default=None,
        doc="From the first to the second; between their middles when absent.",
        example="[1, 0, 0]",
    )
    distance: float | None = key(
        number(0.0),
        default=None,
        doc="How far apart they are put at the start [m]; as they stand when absent.",
        example="0.2",
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


def event_dict(event: Event) -> dict[str, Any]:
    """Return an event as the shot file has it, which :meth:`gsfluent.Scene.add_event` takes."""
    kind = next(name for name, cls in EVENTS.items() if isinstance(event, cls))
    return without_none({"type": kind, **plain(event)})


def read_events(value: Any, place: Place) -> tuple[Event, ...]:
    """Read the list of events."""
    events: tuple[Event, ...] = typed(value, place, EVENTS, "event")
    for index, event in enumerate(events):
        if isinstance(event, Pour):
            either_of(event, ("volume", "duration"), Place(f"{place.path}[{index}]", place.folder))
    return events
