"""``light:`` - lamps, the light from everywhere, and how surfaces answer."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    Section,
    either_of,
    existing_path,
    flag,
    key,
    mapping,
    nested,
    number,
    optional,
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
class KeyLight(Section):
    """``light.key:`` - the directional light."""

    direction: Vector = key(
        read_direction,
        "From the scene towards the light; +z is up.",
        "[1, -1, 2]",
        default=(1.0, -1.0, 2.0),
    )
    shadow: bool = key(
        flag, "Whether the object shadows itself and the floor.", "true", default=True
    )
    intensity: float | None = optional(number(0.0, 1e3), "Strength.", "0.6")
    color: Vector | None = optional(vector(3, 0.0, 1e3), "Linear colour.", "[1, 0.9, 0.8]")
    size: float | None = optional(
        number(0.0, 119.0), "Apparent width [degrees], for soft shadows; the sun has 0.53.", "4"
    )
    samples: int | None = optional(
        whole(1, 64),
        "Parts it is drawn in, each with a shadow map: better wide penumbrae, slower.",
        "1",
    )
    spin: float | None = optional(number(), "Turn about the vertical [degrees per second].", "90")


@dataclasses.dataclass(frozen=True)
class LampSettings(Section):
    """``light.lights[]`` - one more lamp, directional or point."""

    direction: Vector | None = optional(
        read_direction,
        "From the scene towards a directional lamp (this or position).",
        "[-1, 1, 1]",
    )
    position: Vector | None = optional(vector(3), "Where a point lamp is [m].", "[0.3, -0.3, 0.6]")
    color: Vector | None = optional(vector(3, 0.0, 1e3), "Linear colour.", "[0.6, 0.8, 1]")
    intensity: float | None = optional(
        number(0.0, 1e6), "Strength; of a point lamp, at its distance.", "0.3"
    )
    distance: float | None = optional(
        number(above=0.0), "Distance [m] at which a point lamp has its intensity.", "0.5"
    )
    falloff: float | None = optional(
        number(0.0, 10.0), "Exponent of a point lamp's falloff with distance; 0 for none.", "2"
    )
    size: float | None = optional(
        number(0.0, 1e3),
        "Apparent width [degrees] of a directional lamp, diameter [m] of a point lamp.",
        "0.05",
    )
    shadow: bool | None = optional(flag, "Whether matter blocks it.", "false")
    samples: int | None = optional(
        whole(1, 64), "Parts it is drawn in, each with a shadow map.", "4"
    )
    spin: float | None = optional(number(), "Turn about the vertical [degrees per second].", "90")


@dataclasses.dataclass(frozen=True)
class EnvironmentSettings:
    """``light.environment:`` - light from everywhere that differs by direction."""

    sky: Vector | None = optional(
        vector(3, 0.0, 1e3), "Linear radiance of an even sky (with ground).", "[0.5, 0.6, 0.8]"
    )
    ground: Vector | None = optional(
        vector(3, 0.0, 1e3), "Linear radiance of the ground.", "[0.3, 0.25, 0.2]"
    )
    image: Path | None = optional(
        existing_path,
        "Equirectangular picture (.hdr, or a display picture); up is +z, its middle +y.",
        "room.hdr",
    )
    coefficients: tuple[Vector, ...] | None = optional(
        several_of(vector(3), 9, 9),
        "Irradiance over pi in spherical harmonics of degree 2, nine colours.",
        "[[2, 2, 2], [0, 0, 0], [1, 1, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], "
        "[0, 0, 0], [0, 0, 0]]",
    )
    intensity: float = key(number(0.0, 1e3), "Factor on it.", "0.6", default=1.0)
    turn: float = key(number(), "Turn about the vertical [degrees].", "90", default=0.0)


def _lamp(value: Any, place: Place) -> LampSettings:
    settings = section(LampSettings, value, place)
    either_of(settings, ("direction", "position"), place, "give one of them")
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
class LightSettings(Section):
    """``light:``."""

    ambient: float | None = optional(number(0.0, 1e3), "Light from everywhere, even.", "0.4")
    specular: float | None = optional(
        number(0.0, 1e3),
        "Strength of highlights on everything; each material's own when absent.",
        "0.1",
    )
    shininess: float | None = optional(
        number(1.0, 1e4),
        "Narrowness of highlights on everything; each material's own when absent.",
        "40",
    )
    occlusion: float | None = optional(
        number(0.0, 1.0), "How much of the light from everywhere matter hides, 0 for none.", "0.8"
    )
    delight: float | None = optional(
        number(0.0, 1.0),
        "Share of the captured shading that is divided out first; 0 by default.",
        "0.8",
    )
    resolution: int | None = optional(
        whole(16, 8192),
        "Texels along the side of a shadow map; from the picture's size when absent.",
        "1024",
    )
    lights: tuple[LampSettings, ...] | None = optional(
        several(_lamp),
        "More lamps beside the key light.",
        "[{position: [0.3, -0.3, 0.6], intensity: 0.3}]",
    )
    environment: EnvironmentSettings | None = optional(
        _environment,
        "Light from everywhere by direction, beside ambient.",
        "{sky: [0.5, 0.6, 0.8], ground: [0.3, 0.25, 0.2]}",
    )
    # Last, because from here on ``key`` names this field.
    key: KeyLight = key(
        nested(KeyLight), "The directional light.", "{direction: [1, -1, 2]}", default=KeyLight()
    )


def read_light(value: Any, place: Place) -> LightSettings:
    """Read a ``light:`` section, also one that is alone in a file."""
    given = mapping(value, place)
    if set(given) == {"light"}:
        return read_light(given["light"], place.inside("light"))
    return section(LightSettings, given, place)
