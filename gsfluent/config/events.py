"""Events of a shot."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from typing import Any

from gsfluent.config.read import (
    Place,
    key,
    mapping,
    nearest,
    number,
    plain,
    section,
    text,
    vector,
    without_none,
)
from gsfluent.errors import InputError

Vector = tuple[float, float, float]
_LATER_EVENTS = ("blade", "press", "pour", "collide")


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

    velocity: Vector = key(vector(3), doc="Velocity at the start [m/s].", example="[2, 0, 1]")
    spin: Vector = key(
        vector(3),
        default=(0.0, 0.0, 0.0),
        doc="Angular velocity about the centre of mass [rad/s].",
        example="[0, 6, 0]",
    )
    object: str | None = key(
        text, default=None, doc="Which object; all when absent.", example="melon"
    )


@dataclasses.dataclass(frozen=True)
class Bullet:
    """``type: bullet`` - fire a dense ball."""

    start: Vector = key(
        vector(3), name="from", doc="Where it is at time `at` [m].", example="[2, 0, 0.2]"
    )
    toward: Vector = key(vector(3), doc="Point it flies towards [m].", example="[0, 0, 0.1]")
    speed: float = key(number(above=0.0), doc="Speed [m/s].", example="60")
    radius: float = key(number(above=0.0), default=0.008, doc="Radius [m].", example="0.008")
    density: float = key(number(1.0), default=7800.0, doc="Density [kg/m^3].", example="7800")
    at: float = key(
        number(0.0), default=0.0, doc="Time at which it passes `from` [s].", example="0.4"
    )


Event = Drop | Throw | Bullet
EVENTS: dict[str, type[Event]] = {"drop": Drop, "throw": Throw, "bullet": Bullet}


def event_dict(event: Event) -> dict[str, Any]:
    """Return an event as the shot file has it, which :meth:`gsfluent.Scene.add_event` takes."""
    kind = next(name for name, cls in EVENTS.items() if isinstance(event, cls))
    return without_none({"type": kind, **plain(event)})


def read_events(value: Any, place: Place) -> tuple[Event, ...]:
    """Read the list of events."""
    if value is None:
        return ()
    if not isinstance(value, list | tuple):
        raise place.error("be a list of events", value)
    events = []
    for index, item in enumerate(value):
        where = Place(f"{place.path}[{index}]", place.folder)
        settings = mapping(item, where)
        kind = settings.pop("type", None)
        if kind in _LATER_EVENTS:
            raise InputError(
                f"{where.path}: event {kind!r} arrives with a later issue",
                f"now: {', '.join(EVENTS)}",
            )
        if kind not in EVENTS:
            raise InputError(f"{where.path}.type: unknown event {kind!r}", nearest(kind, EVENTS))
        events.append(section(EVENTS[kind], settings, where))
    return tuple(events)
