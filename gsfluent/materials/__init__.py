"""Materials: a constitutive law and its parameters, and presets by name.

``gsfluent.materials.fruit.watermelon``, ``gsfluent.materials.glass`` and so on are
:class:`Material` objects; :func:`get` finds them by name and :meth:`Material.override` changes
single parameters. They stand in ``presets.toml``. Each preset says of every number whether it is
measured, derived, an estimate or chosen by eye (:meth:`Material.source`,
docs/measured/materials.md).

Strength of ``nacc`` material is set by strain, not by stress: the compressive yield pressure is
``kappa * sinh(hardening * max(-alpha, 0))`` and tension fails at ``cohesion * p0``. ``alpha`` is
the log plastic volume ratio: negative is intact, zero and above is broken. The volumetric strain at
which a material fails in tension is :attr:`Material.failure_strain`; a body starts to break when it
lands faster than about ``wave_speed * failure_strain``.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gsfluent.errors import InputError
from gsfluent.materials import phase_field
from gsfluent.materials.laws import (
    BREAKS,
    DEFAULTS,
    HANDBOOK,
    LAWS,
    PARAMETERS,
    RANGES,
    READS,
    WORDS,
)
from gsfluent.materials.material import LOOKS, SCATTER, UNBROKEN, WHOLE, Field, Material, nearest
from gsfluent.materials.strength import LARGEST, STEEPEST, ellipse, opening

__all__ = [
    "BREAKS",
    "DEFAULTS",
    "HANDBOOK",
    "LARGEST",
    "LAWS",
    "LOOKS",
    "PARAMETERS",
    "RANGES",
    "READS",
    "SCATTER",
    "STEEPEST",
    "UNBROKEN",
    "WHOLE",
    "WORDS",
    "Field",
    "Material",
    "ellipse",
    "fruit",
    "get",
    "names",
    "opening",
    "phase_field",
    "wet",
]

_WET = ("fruit", "jelly")
"""Families whose debris is juice: drops, and not powder."""


def _preset(name: str, keys: dict[str, Any]) -> Material:
    """A preset, whose file has the stiffness of the real thing."""
    softening = keys.get("softening", 1.0)
    parts = [
        part | {"young_modulus": part["young_modulus"] / softening}
        if "young_modulus" in part
        else part
        for part in keys.get("parts", ())
    ]
    if "young_modulus" in keys:
        keys = keys | {"young_modulus": keys["young_modulus"] / softening}
    return Material(name, **(keys | {"parts": tuple(parts)}))


_PRESETS: dict[str, Material] = {
    name: _preset(name, keys)
    for name, keys in tomllib.loads(
        Path(__file__).with_name("presets.toml").read_text(encoding="utf-8")
    ).items()
}

fruit = SimpleNamespace(
    **{
        name.split(".", 1)[1]: value
        for name, value in _PRESETS.items()
        if name.startswith("fruit.")
    }
)


def __getattr__(name: str) -> Material:
    """Return the preset of that name: ``materials.glass``, ``materials.water``, ..."""
    try:
        return _PRESETS[name]
    except KeyError:
        raise AttributeError(f"module 'gsfluent.materials' has no attribute {name!r}") from None


def names() -> tuple[str, ...]:
    """Return the names of all presets."""
    return tuple(sorted(_PRESETS))


def wet(name: str) -> bool:
    """Whether what flies off a material is juice; else it is powder.

    Args:
        name: Of the preset; what stands before its first dot is the family.
    """
    return name.split(".")[0] in _WET


def get(name: str) -> Material:
    """Return the preset called ``name``; the group may be left out (``"watermelon"``).

    Raises:
        InputError: No preset has that name; the message gives the nearest one and all names.
    """
    if name in _PRESETS:
        return _PRESETS[name]
    short = {key.split(".")[-1]: value for key, value in _PRESETS.items()}
    if name in short:
        return short[name]
    raise InputError(f"unknown material {name!r}", hint=nearest(name, _PRESETS))
