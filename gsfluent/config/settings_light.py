"""``light:`` - lamps, the light from everywhere, and how surfaces answer."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    existing_path,
    flag,
    key,
    mapping,
    nested,
    number,
    read_direction,
    section,
    several,
    several_of,
    vector,
    whole,
)
from gsfluent.errors import InputError

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class KeyLight:
    """``light.key:`` - the directional light."""

    direction: Vector = key(
        read_direction, default=(1.0, -1.0, 2.0),
        doc="From the scene towards the light; +z is up.", example="[1, -1, 2]",
    )  # fmt: skip
    shadow: bool = key(
        flag, default=True, doc="Whether the object shadows itself and the floor.", example="true"
    )
    intensity: float | None = key(number(0.0, 1e3), default=None, doc="Strength.", example="0.6")
    color: Vector | None = key(
        vector(3, 0.0, 1e3), default=None, doc="Linear colour.", example="[1, 0.9, 0.8]"
    )
    size: float | None = key(
        number(0.0, 119.0),
        default=None,
        doc="Apparent width [degrees], for soft shadows; the sun has 0.53.",
        example="4",
    )
    samples: int | None = key(
        whole(1, 64),
        default=None,
        doc="Parts it is drawn in, each with a shadow map: better wide penumbrae, slower.",
        example="1",
    )
    spin: float | None = key(
        number(), default=None, doc="Turn about the vertical [degrees per second].", example="90"
    )


@dataclasses.dataclass(frozen=True)
class LampSettings:
    """``light.lights[]`` - one more lamp, directional or point."""

    direction: Vector | None = key(
        read_direction,
        default=None,
        doc="From the scene towards a directional lamp (this or position).",
        example="[-1, 1, 1]",
    )
    position: Vector | None = key(
        vector(3), default=None, doc="Where a point lamp is [m].", example="[0.3, -0.3, 0.6]"
    )
    color: Vector | None = key(
        vector(3, 0.0, 1e3), default=None, doc="Linear colour.", example="[0.6, 0.8, 1]"
    )
    intensity: float | None = key(
        number(0.0, 1e6),
        default=None,
        doc="Strength; of a point lamp, at its distance.",
        example="0.3",
    )
    distance: float | None = key(
        number(above=0.0),
        default=None,
        doc="Distance [m] at which a point lamp has its intensity.",
        example="0.5",
    )
    falloff: float | None = key(
        number(0.0, 10.0),
        default=None,
        doc="Exponent of a point lamp's falloff with distance; 0 for none.",
        example="2",
    )
    size: float | None = key(
        number(0.0, 1e3),
        default=None,
        doc="Apparent width [degrees] of a directional lamp, diameter [m] of a point lamp.",
        example="0.05",
    )
    shadow: bool | None = key(flag, default=None, doc="Whether matter blocks it.", example="false")
    samples: int | None = key(
        whole(1, 64), default=None, doc="Parts it is drawn in, each with a shadow map.", example="4"
    )
    spin: float | None = key(
        number(), default=None, doc="Turn about the vertical [degrees per second].", example="90"
    )


@dataclasses.dataclass(frozen=True)
class EnvironmentSettings:
    """``light.environment:`` - light from everywhere that differs by direction."""

    sky: Vector | None = key(
        vector(3, 0.0, 1e3),
        default=None,
        doc="Linear radiance of an even sky (with ground).",
        example="[0.5, 0.6, 0.8]",
    )
    ground: Vector | None = key(
        vector(3, 0.0, 1e3),
        default=None,
        doc="Linear radiance of the ground.",
        example="[0.3, 0.25, 0.2]",
    )
    image: Path | None = key(
        existing_path,
        default=None,
        doc="Equirectangular picture (.hdr, or a display picture); up is +z, its middle +y.",
        example="room.hdr",
    )
    coefficients: tuple[Vector, ...] | None = key(
        several_of(vector(3), 9, 9),
        default=None,
        doc="Irradiance over pi in spherical harmonics of degree 2, nine colours.",
        example="[[2, 2, 2], [0, 0, 0], [1, 1, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], "
        "[0, 0, 0], [0, 0, 0]]",
    )
    intensity: float = key(number(0.0, 1e3), default=1.0, doc="Factor on it.", example="0.6")
    turn: float = key(number(), default=0.0, doc="Turn about the vertical [degrees].", example="90")


def _lamp(value: Any, place: Place) -> LampSettings:
    settings = section(LampSettings, value, place)
    if (settings.direction is None) == (settings.position is None):
        got = "neither" if settings.direction is None else "both"
        raise InputError(
            f"{place.path} must have either 'direction' or 'position', got {got}",
            "give one of them",
        )
    if settings.direction is not None:
        for name in ("distance", "falloff"):
            if getattr(settings, name) is not None:
                raise InputError(
                    f"{place.inside(name).path} does nothing with direction",
                    "remove it, or give position",
                )
        if settings.size is not None and settings.size >= 120.0:
            raise place.inside("size").error("be below 120 degrees", settings.size)
    return settings


def _environment(value: Any, place: Place) -> EnvironmentSettings:
    settings = section(EnvironmentSettings, value, place)
    if (settings.sky is None) != (settings.ground is None):
        raise InputError(f"{place.path} must have sky and ground together", "add the other")
    kinds = [name for name in ("sky", "image", "coefficients") if getattr(settings, name)]
    if len(kinds) != 1:
        got = " and ".join(kinds) if kinds else "none"
        raise InputError(
            f"{place.path} must have one of sky and ground, image, coefficients, got {got}",
            "keep one of them",
        )
    return settings


@dataclasses.dataclass(frozen=True)
class LightSettings:
    """``light:``."""

    ambient: float | None = key(
        number(0.0, 1e3), default=None, doc="Light from everywhere, even.", example="0.4"
    )
    specular: float | None = key(
        number(0.0, 1e3),
        default=None,
        doc="Strength of highlights on everything; each material's own when absent.",
        example="0.1",
    )
    shininess: float | None = key(
        number(1.0, 1e4),
        default=None,
        doc="Narrowness of highlights on everything; each material's own when absent.",
        example="40",
    )
    occlusion: float | None = key(
        number(0.0, 1.0),
        default=None,
        doc="How much of the light from everywhere matter hides, 0 for none.",
        example="0.8",
    )
    delight: float | None = key(
        number(0.0, 1.0),
        default=None,
        doc="Share of the captured shading that is divided out first; 0 by default.",
        example="0.8",
    )
    resolution: int | None = key(
        whole(16, 8192),
        default=None,
        doc="Texels along the side of a shadow map; from the picture's size when absent.",
        example="1024",
    )
    lights: tuple[LampSettings, ...] = key(
        several(_lamp),
        default=(),
        doc="More lamps beside the key light.",
        example="[{position: [0.3, -0.3, 0.6], intensity: 0.3}]",
    )
    environment: EnvironmentSettings | None = key(
        _environment,
        default=None,
        doc="Light from everywhere by direction, beside ambient.",
        example="{sky: [0.5, 0.6, 0.8], ground: [0.3, 0.25, 0.2]}",
    )
    # Last, because from here on ``key`` names this field.
    key: KeyLight = key(
        nested(KeyLight),
        default=KeyLight(),
        doc="The directional light.",
        example="{direction: [1, -1, 2]}",
    )


def read_light(value: Any, place: Place) -> LightSettings:
    """Read a ``light:`` section, also one that is alone in a file."""
    given = mapping(value, place)
    if set(given) == {"light"}:
        return read_light(given["light"], place.inside("light"))
    return section(LightSettings, given, place)
