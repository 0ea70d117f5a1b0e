"""Rigid colliders of a shot."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    choice,
    existing_path,
    flag,
    key,
    number,
    plain,
    read_direction,
    typed,
    vector,
    without_none,
)

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ColliderSettings:
    """What every collider has; :meth:`gsfluent.Scene.add_collider` says what the keys mean."""

    at: Vector = key(
        vector(3), default=(0.0, 0.0, 0.0), doc="Where its middle is [m].", example="[0, 0, 0.1]"
    )
    mode: str = key(
        choice("separate", "slip", "sticky"),
        default="separate",
        doc="Whether matter may leave it, may only slide, or sticks.",
        example="sticky",
    )
    friction: float = key(number(0.0), default=0.4, doc="Coulomb friction.", example="0.4")
    velocity: Vector = key(
        vector(3), default=(0.0, 0.0, 0.0), doc="Velocity [m/s].", example="[0.1, 0, 0]"
    )
    spin: Vector = key(
        vector(3), default=(0.0, 0.0, 0.0), doc="Angular velocity [rad/s].", example="[0, 0, 3]"
    )
    appears: float = key(
        number(0.0), default=0.0,
        doc="When it comes to be, and begins to move [s]; nothing touches it before.",
        example="0.5",
    )  # fmt: skip
    vanishes: float | None = key(
        number(above=0.0), default=None,
        doc="When it is gone [s]; never when absent.", example="1.5",
    )  # fmt: skip
    shown: bool = key(
        flag, default=True, doc="Whether it is drawn (an endless plane never is).", example="false"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeColliderSettings(ColliderSettings):
    """A collider that has an orientation and may be free to move."""

    turn: Vector = key(
        vector(3),
        default=(0.0, 0.0, 0.0),
        doc="How it is turned: degrees about the axis that the numbers point along.",
        example="[0, 0, 45]",
    )
    mass: float | None = key(
        number(above=0.0),
        default=None,
        doc="Mass of one that what it hits can move [kg]; fixed when absent.",
        example="2.0",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlaneCollider(ColliderSettings):
    """``type: plane``."""

    normal: Vector = key(
        read_direction,
        default=(0.0, 0.0, 1.0),
        doc="Normal out of it; matter stays on that side.",
        example="[0, 0, 1]",
    )
    radius: float = key(
        number(0.0), default=0.0, doc="Radius of its disc [m]; 0 is endless.", example="0.2"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SphereCollider(FreeColliderSettings):
    """``type: sphere``."""

    radius: float = key(number(above=0.0), doc="Radius [m].", example="0.1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoxCollider(FreeColliderSettings):
    """``type: box``."""

    size: Vector = key(vector(3, 1e-9), doc="Its edges [m].", example="[0.2, 0.3, 0.1]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CapsuleCollider(FreeColliderSettings):
    """``type: capsule``."""

    radius: float = key(number(above=0.0), doc="Radius [m].", example="0.05")
    length: float = key(
        number(0.0), doc="Between the centres of its caps, along its own z [m].", example="0.2"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CylinderCollider(FreeColliderSettings):
    """``type: cylinder``."""

    radius: float = key(number(above=0.0), doc="Radius [m].", example="0.05")
    length: float = key(number(above=0.0), doc="Along its own z [m].", example="0.2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeshCollider(FreeColliderSettings):
    """``type: mesh``."""

    mesh: Path = key(
        existing_path, doc="Closed mesh that trimesh reads; its origin goes to `at`.",
        example="bowl.obj",
    )  # fmt: skip
    scale: float = key(
        number(above=0.0), default=1.0, doc="Metres per unit of the file.", example="0.001"
    )


COLLIDERS: dict[str, type[ColliderSettings]] = {
    "plane": PlaneCollider,
    "sphere": SphereCollider,
    "box": BoxCollider,
    "capsule": CapsuleCollider,
    "cylinder": CylinderCollider,
    "mesh": MeshCollider,
}


def collider_dict(settings: ColliderSettings) -> dict[str, Any]:
    """Return a collider as the shot file has it."""
    kind = next(name for name, cls in COLLIDERS.items() if type(settings) is cls)
    return without_none({"type": kind, **plain(settings)})


def read_colliders(value: Any, place: Place) -> tuple[ColliderSettings, ...]:
    """Read the list of colliders."""
    return typed(value, place, COLLIDERS, "collider")
