"""The whole shot."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gsfluent.config.colliders import COLLIDERS, ColliderSettings, read_colliders
from gsfluent.config.events import EVENTS, Event, read_events
from gsfluent.config.objects import ObjectSettings, read_objects
from gsfluent.config.read import (
    INPUTS,
    Place,
    choice,
    either,
    input_path,
    key,
    nearest,
    nested,
    number,
    optional,
    plain,
    read_direction,
    section,
    typed_dict,
    vector,
    without_none,
)
from gsfluent.config.settings import (
    FillSettings,
    HeatSettings,
    OutputSettings,
    ReconstructSettings,
    TextureSettings,
    Vector,
    read_texture,
)
from gsfluent.config.settings_light import LightSettings
from gsfluent.config.settings_solve import SolveSettings, read_solve
from gsfluent.errors import InputError, short

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def _axis(value: Any, place: Place) -> str | tuple[float, ...]:
    if not isinstance(value, str):
        return read_direction(value, place)
    if value == "auto":
        return value
    axis = value.lstrip("+-")
    if axis not in _AXES or value[:-1] not in ("", "+", "-"):
        raise place.error("be auto, +x, -x, +y, -y, +z, -z or [x, y, z]", value)
    sign = -1.0 if value.startswith("-") else 1.0
    return tuple(sign * part + 0.0 for part in _AXES[axis])


def _front(value: Any, place: Place) -> str | tuple[float, ...]:
    return value if value == "guess" else _axis(value, place)


@dataclasses.dataclass(frozen=True)
class Shot:
    """One shot: what is read, what happens to it, what is written. Paths are absolute."""

    capture: Path | None = optional(
        input_path("capture"),
        "Folder with a COLMAP model, transforms.json or Polycam's keyframes, or a zip of one "
        "(this, splats or mesh).",
        "captures/apple",
    )
    splats: Path | None = optional(
        input_path("splats"),
        "Trained splat: .ply, .splat, .spz, .ksplat, .sog, .pt or .ckpt; or a solid that "
        "`gsfluent fill` wrote (this, capture or mesh).",
        "melon.ply",
    )
    mesh: Path | None = optional(
        input_path("mesh"),
        "Triangle mesh: .obj, .glb, .stl, .ply and others, with texture or vertex colours "
        "(this, capture or splats).",
        "vase.glb",
    )
    scale: float | None = optional(
        number(above=0.0), "Metres per world unit; from size when absent.", "0.08"
    )
    size: float | None = optional(
        number(above=0.0), "Largest extent of the object [m], instead of scale.", "0.08"
    )
    up: str | Vector = key(
        _axis, "Up axis of the input: auto, +x to -z, or [x, y, z].", "-y", default="auto"
    )
    front: str | Vector = key(
        _front,
        "Side of the input that faces the camera when the film begins: auto (the first photograph; "
        "without one the custom of the axes), guess (where most photographers stood; without them "
        "the side with the most to see), +x to -z, or [x, y, z].",
        "+x",
        default="auto",
    )
    floor: str | float = key(
        either(choice("auto", "none", "plane"), number()),
        "Floor: auto (below the object), plane (what it stood on in the capture), none, or its "
        "height along up: input coordinate times scale [m].",
        "auto",
        default="auto",
    )
    floor_mode: str = key(
        choice("separate", "slip", "sticky"),
        "Whether matter may leave the floor, may only slide on it, or sticks.",
        "sticky",
        default="separate",
    )
    floor_friction: float = key(number(0.0), "Coulomb friction of the floor.", "0.6", default=0.4)
    origin: str = key(
        choice("auto", "input"),
        "Where the scene's z axis stands: auto (in the middle of the object) or input (where "
        "the input has its own origin).",
        "input",
        default="auto",
    )
    gravity: Vector = key(
        vector(3),
        "Acceleration that pulls everything [m/s^2].",
        "[0, 0, -1.62]",
        default=(0.0, 0.0, -9.81),
    )
    reconstruct: ReconstructSettings = key(
        nested(ReconstructSettings),
        "Photographs to splats.",
        "{iterations: 7000}",
        default=ReconstructSettings(),
    )
    fill: FillSettings = key(
        nested(FillSettings), "Splats to a solid.", "{hollow: none}", default=FillSettings()
    )
    texture: TextureSettings = key(
        read_texture, "Colours for the inside.", "{method: color_copy}", default=TextureSettings()
    )
    objects: Mapping[str, ObjectSettings] = key(
        read_objects,
        "What the objects are made of, by name; one object named `object` when absent.",
        "{melon: {material: fruit.watermelon}}",
        default={},
    )
    events: tuple[Event, ...] = key(
        read_events, "What happens.", "[{type: drop, height: 1.0}]", default=()
    )
    colliders: tuple[ColliderSettings, ...] = key(
        read_colliders,
        "Rigid things that matter cannot enter.",
        "[{type: sphere, at: [0, 0, 0.1], radius: 0.1}]",
        default=(),
    )
    heat: HeatSettings | None = optional(
        nested(HeatSettings),
        "What is around objects that have a temperature (objects.NAME.temperature).",
        "{floor: 60, speed: 100}",
    )
    solve: SolveSettings = key(
        read_solve, "How accurately.", "{quality: preview}", default=SolveSettings()
    )
    light: LightSettings = key(
        nested(LightSettings), "The light.", "{ambient: 0.4}", default=LightSettings()
    )
    output: OutputSettings = key(
        nested(OutputSettings), "What is written.", "{seconds: 2}", default=OutputSettings()
    )

    @staticmethod
    def from_dict(values: Mapping[str, Any], folder: str | Path = ".") -> Shot:
        """Read a shot from plain values.

        Args:
            values: Keys and values as in a shot file.
            folder: Where relative paths start.

        Raises:
            InputError: An unknown or missing key, or a value out of range; the message names
                its path.
        """
        shot = section(Shot, values, Place("", Path(folder)))
        named = [name for name in INPUTS if getattr(shot, name) is not None]
        if len(named) != 1:
            got = " and ".join(named) or "none"
            raise InputError(
                f"the shot must have one of {', '.join(INPUTS)}, got {got}", "name one input"
            )
        if shot.scale is not None and shot.size is not None:
            raise InputError(
                "'scale' and 'size' both set the size of the object", "keep one of them"
            )
        if shot.capture is None and shot.reconstruct != ReconstructSettings():
            raise InputError(
                f"reconstruct: does nothing when {named[0]} is given", "remove the section"
            )
        if shot.mesh is not None and shot.fill.method != "auto":
            raise InputError(
                f"fill.method: {shot.fill.method} does nothing with a mesh, whose inside is known",
                "remove the key",
            )
        if shot.floor == "plane" and shot.capture is None:
            raise InputError(
                f"floor: plane is found in a capture, got {named[0]}", "use auto, or its height"
            )
        if shot.capture is None:
            _refuse_photographs(shot.objects)
        if not shot.objects:
            shot = dataclasses.replace(shot, objects={"object": ObjectSettings("object")})
        if shot.heat is not None and all(o.temperature is None for o in shot.objects.values()):
            raise InputError(
                "heat: does nothing where no object has a temperature",
                "give objects.NAME.temperature, or remove the section",
            )
        if shot.floor == "none" and shot.heat is not None and shot.heat.floor is not None:
            raise InputError("heat.floor does nothing without a floor", "drop it")
        if shot.floor == "none" and (shot.floor_mode, shot.floor_friction) != ("separate", 0.4):
            raise InputError(
                "floor_mode and floor_friction do nothing without a floor", "drop them"
            )
        for index, event in enumerate(shot.events):
            one = getattr(event, "object", None)
            for name in [one] if one is not None else getattr(event, "objects", ()):
                if name not in shot.objects:
                    raise InputError(
                        f"events[{index}]: no object is called {short(name)}",
                        nearest(name, shot.objects),
                    )
        return shot

    def resolved(self) -> dict[str, Any]:
        """Return every setting as plain values, defaults filled in; reads back as the same."""
        values: dict[str, Any] = plain(self)
        values["objects"] = {name: item.to_dict() for name, item in self.objects.items()}
        values["events"] = [typed_dict(event, EVENTS) for event in self.events]
        values["colliders"] = [typed_dict(settings, COLLIDERS) for settings in self.colliders]
        return without_none(values)


def _refuse_photographs(objects: Mapping[str, ObjectSettings]) -> None:
    """Refuse parts that are told by photographs where there are none."""
    for name, settings in objects.items():
        for part in settings.parts or ():
            for kind in ("mask", "labels"):
                if getattr(part.where, kind) is not None:
                    raise InputError(
                        f"objects.{name}.parts.{part.name}.where.{kind} needs photographs",
                        "start from the capture, or use label_image",
                    )


def load_shot(path: str | Path) -> Shot:
    """Read a shot file; relative paths in it start from its own folder.

    Raises:
        InputError: Missing file, invalid YAML, or anything :meth:`Shot.from_dict` refuses.
    """
    from gsfluent.config.yaml_file import read_yaml
    from gsfluent.io.capture import kind_of

    path = Path(path)
    if (kind := kind_of(path)) in INPUTS:
        raise InputError(
            f"{path}: {INPUTS[kind]} is no shot file",
            f"write {kind}: {path.name} into a shot.yaml, or gsfluent run {path.name} -o out",
        )
    values = read_yaml(path)
    if not isinstance(values, Mapping):
        raise InputError(
            f"{path}: must be a YAML mapping, got {type(values).__name__}",
            "see docs/guide/shot-keys.md",
        )
    try:
        return Shot.from_dict(values, path.resolve().parent)
    except InputError as error:
        raise InputError(f"{path}: {error.what}", error.hint) from error


_STARTS = ("command", "model", "ip_adapter", "controlnet")
"""Keys whose values start a program, or load a model, which may hold one."""


def refuse_programs(shot: Shot, source: str | Path) -> None:
    """Refuse a shot that would start a program of its own or load a model.

    Args:
        shot: The shot.
        source: Where it is from, for the message.

    Raises:
        InputError: It would.
    """

    def found(value: Any, path: str) -> Iterator[str]:
        for name, item in value.items() if isinstance(value, dict) else ():
            if name in _STARTS:
                yield f"{path}{name}"
            yield from found(item, f"{path}{name}.")

    for path in found(shot.resolved(), ""):
        raise InputError(
            f"{source}: {path} starts a program or loads a model, and the shot is not trusted",
            "remove the key, or leave --untrusted out when you know who wrote it",
        )
