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
    optional,
    read_direction,
    typed,
    vector,
)

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ColliderSettings:
    """What every collider has; :meth:`gsfluent.Scene.add_collider` says what the keys mean."""

    at: Vector = key(vector(3), "Where its middle is [m].", "[0, 0, 0.1]", default=(0.0, 0.0, 0.0))
    mode: str = key(
        choice("separate", "slip", "sticky"),
        "Whether matter may leave it, may only slide, or sticks.",
        "sticky",
        default="separate",
    )
    friction: float = key(number(0.0), "Coulomb friction.", "0.4", default=0.4)
    velocity: Vector = key(vector(3), "Velocity [m/s].", "[0.1, 0, 0]", default=(0.0, 0.0, 0.0))
    spin: Vector = key(vector(3), "Angular velocity [rad/s].", "[0, 0, 3]", default=(0.0, 0.0, 0.0))
    appears: float = key(
        number(0.0),
        "When it comes to be, and begins to move [s]; nothing touches it before.",
        "0.5",
        default=0.0,
    )
    vanishes: float | None = optional(
        number(above=0.0), "When it is gone [s]; never when absent.", "1.5"
    )
    shown: bool = key(
        flag, "Whether it is drawn (an endless plane never is).", "false", default=True
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeColliderSettings(ColliderSettings):
    """A collider that has an orientation and may be free to move."""

    turn: Vector = key(
        vector(3),
        "How it is turned: degrees about the axis that the numbers point along.",
        "[0, 0, 45]",
        default=(0.0, 0.0, 0.0),
    )
    mass: float | None = optional(
        number(above=0.0), "Mass of one that what it hits can move [kg]; fixed when absent.", "2.0"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlaneCollider(ColliderSettings):
    """``type: plane``."""

    normal: Vector = key(
        read_direction,
        "Normal out of it; matter stays on that side.",
        "[0, 0, 1]",
        default=(0.0, 0.0, 1.0),
    )
    radius: float = key(number(0.0), "Radius of its disc [m]; 0 is endless.", "0.2", default=0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SphereCollider(FreeColliderSettings):
    """``type: sphere``."""

    radius: float = key(number(above=0.0), "Radius [m].", "0.1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoxCollider(FreeColliderSettings):
    """``type: box``."""

    size: Vector = key(vector(3, 1e-9), "Its edges [m].", "[0.2, 0.3, 0.1]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CapsuleCollider(FreeColliderSettings):
    """``type: capsule``."""

    radius: float = key(number(above=0.0), "Radius [m].", "0.05")
    length: float = key(number(0.0), "Between the centres of its caps, along its own z [m].", "0.2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CylinderCollider(FreeColliderSettings):
    """``type: cylinder``."""

    radius: float = key(number(above=0.0), "Radius [m].", "0.05")
    length: float = key(number(above=0.0), "Along its own z [m].", "0.2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeshCollider(FreeColliderSettings):
    """``type: mesh``."""

    mesh: Path = key(
        existing_path, "Closed mesh that trimesh reads; its origin goes to `at`.", "bowl.obj"
    )
    scale: float = key(number(above=0.0), "Metres per unit of the file.", "0.001", default=1.0)


COLLIDERS: dict[str, type[ColliderSettings]] = {
    "plane": PlaneCollider,
    "sphere": SphereCollider,
    "box": BoxCollider,
    "capsule": CapsuleCollider,
    "cylinder": CylinderCollider,
    "mesh": MeshCollider,
}


def read_colliders(value: Any, place: Place) -> tuple[ColliderSettings, ...]:
    """Read the list of colliders."""
    return typed(value, place, COLLIDERS, "collider")
