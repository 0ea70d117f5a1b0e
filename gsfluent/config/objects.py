"""Objects of a shot: which splats, what material, which parts differ."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    Section,
    existing_path,
    mapping,
    number,
    optional,
    plain,
    refuse_unknown,
    section,
    text,
    vector,
    whole,
)
from gsfluent.errors import InputError, short

Vector = tuple[float, float, float]


def read_box(value: Any, place: Place) -> tuple[tuple[float, ...], ...]:
    """Read two corners, the lower one first."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise place.error("be two corners [[x, y, z], [x, y, z]]", value)
    low, high = (vector(3)(corner, place.inside(str(index))) for index, corner in enumerate(value))
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise place.error("have its first corner below its second in x, y and z", value)
    return low, high


def read_sphere(value: Any, place: Place) -> tuple[float, ...]:
    """Read x, y, z and a positive radius."""
    numbers: tuple[float, ...] = vector(4)(value, place)
    if not numbers[3] > 0:
        raise place.error("have a positive radius", value)
    return numbers


def read_label(value: Any, place: Place) -> str | int:
    """Read the name or the number of a label."""
    if isinstance(value, str):
        return str(text(value, place))
    number_: int = whole(1, 2**31 - 1)(value, place)
    return number_


def read_label_image(value: Any, place: Place) -> Path | dict[str, Path]:
    """Read a file, or files by axis."""
    if not isinstance(value, Mapping):
        return existing_path(value, place)
    images = mapping(value, place)
    refuse_unknown(images, ("x", "y", "z"), place)
    if not images:
        raise place.error("name a file for x, y or z", value)
    return {axis: existing_path(file, place.inside(axis)) for axis, file in images.items()}


@dataclasses.dataclass(frozen=True)
class Where(Section):
    """``where:`` - which matter a part is made of; all conditions given must hold."""

    depth_below: float | None = optional(
        number(above=0.0), "Closer to the surface than this [m].", "0.012"
    )
    depth_above: float | None = optional(number(0.0), "Deeper than this [m].", "0.012")
    color_near: Vector | None = optional(
        vector(3, 0.0, 1.0), "Coloured like this, RGB in 0..1.", "[0.1, 0.07, 0.05]"
    )
    tolerance: float | None = optional(
        number(0.0, 2.0), "Largest RGB distance from color_near (0.15 if absent).", "0.15"
    )
    box: tuple[Vector, Vector] | None = optional(
        read_box,
        "Inside this box, scene metres: two corners.",
        "[[-0.1, -0.1, 0], [0.1, 0.1, 0.05]]",
    )
    sphere: tuple[float, ...] | None = optional(
        read_sphere, "Inside this sphere, scene metres: x, y, z, radius.", "[0, 0, 0.1, 0.05]"
    )
    mask: Path | None = optional(
        existing_path, "Folder with a mask per photograph: white is this part.", "parts/stem"
    )
    labels: Path | None = optional(
        existing_path,
        "Segmentation of the photographs: label images, a folder of masks per label, "
        "Segment Anything's folders or JSON, NumPy maps; picks label.",
        "segmentation",
    )
    label_image: Path | dict[str, Path] | None = optional(
        read_label_image,
        "Picture of labels projected along an axis (x, y, z) of the scene, or, without an "
        "axis, of a cut whose labels follow depth; picks label.",
        "{x: side.png}",
    )
    label: str | int | None = optional(
        read_label,
        "Label in labels or label_image, by name, number or colour (any label if absent); "
        "alone: a region that the solid has already (inclusion).",
        "leaf",
    )
    region: int | None = optional(whole(0, 2**31 - 1), "Part number in the solid's voxels.", "1")


@dataclasses.dataclass(frozen=True)
class Part:
    """One entry of ``parts:`` - a region with parameters of its own."""

    name: str
    where: Where
    overrides: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the form that :meth:`gsfluent.Scene.add` takes."""
        return {"name": self.name, "where": self.where.given(), **self.overrides}


@dataclasses.dataclass(frozen=True)
class Select(Section):
    """``select:`` - which splats belong to an object; ``all`` when nothing is set. Scene metres."""

    box: tuple[Vector, Vector] | None = optional(
        read_box, "Centres inside this box [m].", "[[-0.1, -0.1, 0], [0.1, 0.1, 0.2]]"
    )
    sphere: tuple[float, ...] | None = optional(
        read_sphere, "Centres inside this sphere [m]: x, y, z, radius.", "[0, 0, 0.1, 0.15]"
    )
    color_near: Vector | None = optional(
        vector(3, 0.0, 1.0), "Coloured like this, RGB in 0..1.", "[0.6, 0.1, 0.1]"
    )
    tolerance: float | None = optional(
        number(0.0, 2.0), "Largest RGB distance from color_near (0.15 if absent).", "0.2"
    )
    labels: Path | None = optional(
        existing_path, "NumPy file with one number per splat; picks label.", "labels.npy"
    )
    label: int | None = optional(
        whole(-(2**31), 2**31 - 1), "Number in the label file (1 if absent).", "1"
    )

    @property
    def everything(self) -> bool:
        """Whether nothing is left out."""
        return not self.given()


@dataclasses.dataclass(frozen=True)
class ObjectSettings:
    """One entry of ``objects:`` - what it is made of."""

    name: str
    select: Select = dataclasses.field(default_factory=Select)
    material: str = "fruit.watermelon"
    overrides: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    parts: tuple[Part, ...] | None = None
    temperature: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for run.json."""
        parts = None if self.parts is None else [plain(part.to_dict()) for part in self.parts]
        select = "all" if self.select.everything else plain(self.select.given())
        return {
            "select": select,
            "material": self.material,
            **plain(self.overrides),
            "parts": parts,
            # as it was before there was heat, where none is named
            **({} if self.temperature is None else {"temperature": self.temperature}),
        }


def read_objects(value: Any, place: Place) -> dict[str, ObjectSettings]:
    """Read the objects by name."""
    return {
        name: _object(name, item, place.inside(name))
        for name, item in mapping(value, place).items()
    }


def _object(name: str, value: Any, place: Place) -> ObjectSettings:
    from gsfluent import materials

    settings = mapping(value, place)
    own = ("select", "material", "parts", "temperature", *materials.WHOLE)
    _refuse_parameters(settings, own, place)
    material = text(settings.pop("material", "fruit.watermelon"), place.inside("material"))
    select = _select(settings.pop("select", "all"), place.inside("select"))
    parts = settings.pop("parts", None)
    warm = settings.pop("temperature", None)
    if warm is not None:
        warm = _temperature(material, warm, place.inside("temperature"))
    overrides = _parameters(material, settings, place)
    return ObjectSettings(
        name,
        select,
        material,
        overrides,
        None if parts is None else _parts(material, overrides, parts, place.inside("parts")),
        warm,
    )


def _temperature(material: str, value: Any, place: Place) -> float:
    """Read the temperature of an object that can melt."""
    from gsfluent.materials.heat import thermal

    degrees: float = number(-273.15)(value, place)
    try:
        thermal(material)
    except InputError as error:
        raise InputError(
            f"{place.path}: nothing is known of the heat of {short(material)}", error.hint
        ) from None
    return degrees


def _select(value: Any, place: Place) -> Select:
    if value == "all":
        return Select()
    if isinstance(value, str):
        raise place.error("be all, or a section with box, sphere, color_near or labels", value)
    select = section(Select, value, place)
    _needs(select.tolerance, select.color_near, "tolerance", "color_near", place)
    _needs(select.label, select.labels, "label", "labels", place)
    if select.everything:
        raise place.error("name a condition", value, "write select: all")
    return select


def _needs(inner: Any, outer: Any, name: str, other: str, place: Place) -> None:
    if inner is not None and outer is None:
        raise InputError(
            f"{place.inside(name).path} does nothing without {other}",
            f"add {other} or remove {name}",
        )


def _parts(material: str, base: Mapping[str, Any], value: Any, place: Place) -> tuple[Part, ...]:
    if not isinstance(value, list | tuple):
        raise place.error("be a list of parts", value)
    parts = []
    for index, item in enumerate(value):
        where = Place(f"{place.path}[{index}]", place.folder)
        settings = mapping(item, where)
        name = text(settings.pop("name", f"part{index + 1}"), where.inside("name"))
        where = Place(f"{place.path}.{name}", place.folder)
        _refuse_whole(settings, where)
        _refuse_parameters(settings, ("where", "material"), where)
        chosen = section(Where, settings.pop("where", None), where.inside("where"))
        _needs(
            chosen.tolerance, chosen.color_near, "tolerance", "color_near", where.inside("where")
        )
        _one_source(chosen, where.inside("where"))
        if not chosen.given():
            raise InputError(
                f"{where.path}.where must name a condition",
                "for example where: {depth_below: 0.01}",
            )
        own = settings.pop("material", None)
        if own is None:
            overrides = _parameters(material, settings, where, base)
        else:
            overrides = {
                "material": text(own, where.inside("material")),
                **_parameters(own, settings, where),
            }
        if not overrides:
            raise InputError(
                f"{where.path} changes no parameter",
                "add one, for example cohesion: 2.0, or remove the part",
            )
        parts.append(Part(name, chosen, overrides))
    return tuple(parts)


def _one_source(chosen: Where, place: Place) -> None:
    given_ = [name for name in ("mask", "labels", "label_image") if getattr(chosen, name)]
    if len(given_) > 1:
        raise InputError(
            f"{place.path} has both {given_[0]} and {given_[1]}", "keep one of them, or two parts"
        )
    if chosen.mask is not None and chosen.label is not None:
        raise InputError(
            f"{place.inside('label').path} does nothing with mask", "remove it, or write labels"
        )


def _refuse_whole(settings: Mapping[str, Any], place: Place) -> None:
    from gsfluent import materials

    for name in materials.WHOLE:
        if name in settings:
            raise InputError(
                f"{place.inside(name).path} is of a part, but {name} holds for a whole object",
                f"give {name} to the object",
            )


def _refuse_parameters(settings: Mapping[str, Any], extra: tuple[str, ...], place: Place) -> None:
    from gsfluent import materials

    refuse_unknown(
        settings,
        [*extra, *materials.WORDS, *materials.PARAMETERS, *materials.SCATTER, *materials.LOOKS],
        place,
    )


def _parameters(
    material: str, settings: Mapping[str, Any], place: Place, base: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Read material parameters and try them on the preset, so that a bad number is refused here."""
    from gsfluent import materials

    read = {
        name: value
        if name == "length" and value == "auto"
        else (text if name in materials.WORDS else number())(value, place.inside(name))
        for name, value in settings.items()
    }
    try:
        preset = materials.get(material).override(**dict(base or {}))
    except InputError as error:
        raise InputError(f"{place.inside('material').path}: {error.what}", error.hint) from error
    try:
        preset.override(**read)  # together: a law is chosen with the parameters that it needs
    except InputError as error:
        blamed = next((name for name in read if f": {name} " in error.what), "law")
        raise InputError(f"{place.inside(blamed).path}: {error.what}", error.hint) from error
    return read
