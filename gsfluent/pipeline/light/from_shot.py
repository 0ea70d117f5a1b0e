"""The light that a shot, a light file or the command line asks for."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.config import Shot
from gsfluent.config.read import Place
from gsfluent.config.settings_light import EnvironmentSettings, LightSettings, read_light
from gsfluent.config.yaml_file import read_yaml
from gsfluent.errors import InputError
from gsfluent.pipeline.light import environment
from gsfluent.pipeline.light.lamps import (
    SHININESS,
    SPECULAR,
    Lamp,
    Lighting,
    studio_light,
)
from gsfluent.pipeline.liquid.clear import Clear
from gsfluent.results.frames import DUST, SavedFrame

JUICE = (0.1, 16.0)
"""k_s and n_s of chips and mist of what is wet: a film of juice on each side."""
_SHARED = ("ambient", "specular", "shininess", "occlusion", "delight", "resolution")


def light_of(shot: Shot) -> Lighting:
    """The shot's light; what it leaves out keeps the default.

    That is the studio's fill and rim beside the key light, unless it gives ``ambient``,
    ``environment`` or ``lights``.

    Raises:
        InputError: A number out of range, or an environment picture that cannot be read.
    """
    return _lighting(shot.light)


def _lighting(settings: LightSettings) -> Lighting:
    # who gives one of these lights the scene himself: nothing that he did not ask for is added
    own = any(getattr(settings, name) is not None for name in ("ambient", "environment", "lights"))
    usual = Lighting() if own else studio_light()
    key, *others = usual.lamps
    others += [Lamp(**lamp.given()) for lamp in settings.lights or ()]
    shared = {name: value for name, value in settings.given().items() if name in _SHARED}
    if settings.environment is not None:
        shared["environment"] = _environment(settings.environment)
    return replace(usual, lamps=(replace(key, **settings.key.given()), *others), **shared)


def changed(
    lighting: Lighting,
    *,
    light: str | None = None,
    lamps: tuple[str, ...] = (),
    surroundings: str | None = None,
    intensity: float | None = None,
    lamp_size: float | None = None,
    spin: float | None = None,
    **shared: float | None,
) -> Lighting:
    """The lighting with what the command line changes.

    Args:
        lighting: What the shot says.
        light: ``x,y,z`` or ``key=x,y,z``: toward the key light; or a YAML file with a ``light:``
            section, which replaces all.
        lamps: More lamps: ``point=x,y,z``, ``sun=x,y,z``, each with ``;name=value`` for what else
            a lamp has, such as ``point=0.3,0,0.5;intensity=2;color=1,0.8,0.6``.
        surroundings: An equirectangular picture, ``sky``, or ``none``.
        intensity: Of the key light.
        lamp_size: Of the key light.
        spin: Of the key light [degrees per second].
        shared: ``ambient``, ``specular``, ``shininess``, ``occlusion``, ``delight``.

    Raises:
        InputError: What was given cannot be read.
    """
    direction = None
    if light is not None:
        text = light.removeprefix("key=")
        if Path(text).suffix.lower() in (".yaml", ".yml"):
            place = Place("", Path(text).parent)
            lighting = _lighting(read_light(read_yaml(Path(text)), place))
        else:
            direction = _numbers(text, "--light")
    key = {"direction": direction, "intensity": intensity, "size": lamp_size, "spin": spin}
    key = {name: value for name, value in key.items() if value is not None}
    if key:
        first = lighting.lamps[0] if lighting.lamps else Lamp()
        if direction is not None:
            key["position"] = None
        lighting = replace(
            lighting,
            lamps=(replace(first, **key), *lighting.lamps[1:]),  # type: ignore[arg-type]
        )
    if lamps:
        more = tuple(_lamp(text) for text in lamps)
        lighting = replace(lighting, lamps=(*lighting.lamps, *more))
    if surroundings is not None:
        lighting = replace(lighting, environment=_surroundings(surroundings))
    return replace(lighting, **{k: v for k, v in shared.items() if v is not None})  # type: ignore[arg-type]


def looks_of(shot: Shot) -> dict[str, tuple[float, float, float]]:
    """k_s, n_s and transmission of every object of a shot.

    A picture hangs on them, its simulation does not.
    """
    made = {
        name: materials.get(settings.material).override(**dict(settings.overrides))
        for name, settings in shot.objects.items()
    }
    return {name: (each.specular, each.shininess, each.transmission) for name, each in made.items()}


def gloss_of(shot: Shot, frame: SavedFrame) -> Tensor | None:
    """k_s and n_s of every splat, [N, 2], from the material of the body that it follows.

    None for frames that do not say which body is what (written by an older gsfluent). Splats of
    rigid things are steel, and the dust of what is wet has juice on it (:data:`JUICE`).
    """
    names = frame.facts.get("bodies")
    if not names:
        return None
    rows, looks, wet = [], looks_of(shot), []
    for name, preset in names:
        row = looks[name][:2] if name in looks else (SPECULAR, SHININESS)
        if name not in looks and preset in materials.names():
            made_of = materials.get(preset)
            row = (made_of.specular, made_of.shininess)
        rows.append(row)
        wet.append(materials.wet(preset))
    rows += [(materials.get("steel").specular, materials.get("steel").shininess), JUICE]
    table = torch.tensor(rows).to(frame.gaussians.means)
    anchor = frame.anchor.long()
    body = frame.body[anchor.clamp(min=0)].long()
    looks_like = torch.where(anchor >= 0, body, len(wet))
    if frame.dust is not None:
        juice = torch.tensor([*wet, False], device=anchor.device)[looks_like]
        looks_like = torch.where((frame.ids >= DUST) & juice, len(wet) + 1, looks_like)
    return table[looks_like]


def plates_of(frame: SavedFrame) -> Tensor:
    """Splats whose shortest axis is their normal, bool [N]: those of rigid things, and of dust.

    Grains are left out of the density that other normals come from.
    """
    return (frame.anchor < 0) | (frame.ids >= DUST)


def transmission_of(shot: Shot, frame: SavedFrame) -> Tensor | None:
    """Transmission of every splat, [N]; None where nothing lets light through.

    Dust of what is clear is not: powdered glass scatters.
    """
    looks = looks_of(shot)
    clear = [looks[name][2] if name in looks else 0.0 for name, _ in frame.facts.get("bodies", ())]
    if not any(clear):
        return None
    table = torch.tensor([*clear, 0.0]).to(frame.gaussians.means)
    anchor = frame.anchor.long()
    body = frame.body[anchor.clamp(min=0)].long()
    solid = (anchor >= 0) & (frame.ids < DUST)
    return table[torch.where(solid, body, len(clear))]


def clear_of(frame: SavedFrame) -> Clear | None:
    """The splats of liquids; None where there are none.

    A liquid lets through as much of the light on every centimetre as its ``transmission`` says.
    """
    bodies = [
        materials.get(preset) if preset in materials.names() else None
        for _, preset in frame.facts.get("bodies", ())
    ]
    liquids = [made for made in bodies if made is not None and made.law == "fluid"]
    inside = frame.facts.get("liquid_inside", ())
    if not liquids and not inside:
        return None
    like = frame.gaussians.means
    anchor = frame.anchor.long()
    body = frame.body[anchor.clamp(min=0)].long()
    flows = torch.tensor([made in liquids for made in bodies], device=like.device)
    clarity = like.new_tensor([1.0 if made is None else made.transmission for made in bodies])
    # what was inside a solid has its colours, and lets no light through
    flows[list(inside)], clarity[list(inside)] = True, 0.0
    # those of solids have numbers up from 0, those of the repair too
    rows = (anchor >= 0) & (frame.ids < 0) & flows[body]
    wet = liquids[0] if liquids else materials.get("water")
    return Clear(
        rows=rows,
        volume=frame.volumes[anchor[rows]],
        attenuation=-100.0 * clarity.log()[body[rows]],
        gloss=like.new_tensor([wet.specular, wet.shininess]),
    )


def _environment(settings: EnvironmentSettings) -> environment.Coefficients | None:
    if settings.coefficients is not None:
        found = settings.coefficients
    elif settings.image is not None:
        found = environment.of_file(settings.image)
    else:
        assert settings.sky is not None and settings.ground is not None  # the reader's rule
        found = environment.sky_and_ground(settings.sky, settings.ground)
    if settings.turn:
        found = environment.turned(found, settings.turn)
    return environment.scaled(found, settings.intensity)


def _surroundings(text: str) -> environment.Coefficients | None:
    if text == "none":
        return None
    if text == "sky":
        return environment.sky_and_ground((0.45, 0.55, 0.75), (0.25, 0.22, 0.18))
    if not Path(text).is_file():
        raise InputError(f"--environment {text}: no such file", "give a picture, sky or none")
    return environment.of_file(Path(text))


def _lamp(text: str) -> Lamp:
    """Read ``point=x,y,z;name=value...``."""
    values: dict[str, Any] = {}
    for part in text.split(";"):
        name, _, value = part.strip().partition("=")
        numbers = _numbers(value, f"--lamp {name}", count=None)
        if name in ("point", "sun"):
            values["position" if name == "point" else "direction"] = _numbers(value, "--lamp")
        elif name == "color":
            values[name] = _numbers(value, "--lamp color")
        elif name in {f.name for f in fields(Lamp)} and len(numbers) == 1:
            values[name] = int(numbers[0]) if name == "samples" else numbers[0]
        else:
            raise InputError(
                f"--lamp {text}: {part!r} is not understood",
                "such as point=0.3,0,0.5;intensity=2;color=1,0.8,0.6 or sun=-1,1,1;size=10",
            )
    if ("position" in values) == ("direction" in values):
        raise InputError(f"--lamp {text}: no place", "begin with point=x,y,z or sun=x,y,z")
    return Lamp(**values)


def _numbers(text: str, what: str, count: int | None = 3) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or (count is not None and len(numbers) != count):
        raise InputError(f"{what} {text!r}", "give numbers such as 1,-1,2")
    return numbers
