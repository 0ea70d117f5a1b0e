"""The tables of docs/guide/shot-keys.md, made from the dataclasses: page and program agree."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from gsfluent import materials
from gsfluent.config.colliders import COLLIDERS
from gsfluent.config.events import EVENTS
from gsfluent.config.objects import Select, Where
from gsfluent.config.read import key_name, plain
from gsfluent.config.settings import (
    FillSettings,
    HeatSettings,
    OutputSettings,
    PhotoSettings,
    ReconstructSettings,
    TextureSettings,
)
from gsfluent.config.settings_inpaint import InpaintSettings
from gsfluent.config.settings_light import (
    EnvironmentSettings,
    KeyLight,
    LampSettings,
    LightSettings,
)
from gsfluent.config.settings_solve import SolveSettings
from gsfluent.config.shot import Shot
from gsfluent.materials.heat import THERMAL

SECTIONS: dict[str, type[Any]] = {
    "(top level)": Shot,
    "reconstruct": ReconstructSettings,
    "fill": FillSettings,
    "texture": TextureSettings,
    "texture.inpaint": InpaintSettings,
    "texture.photo": PhotoSettings,
    "objects.NAME.select": Select,
    "objects.NAME.parts[].where": Where,
    **{f"events[] with type: {name}": cls for name, cls in EVENTS.items()},
    **{f"colliders[] with type: {name}": cls for name, cls in COLLIDERS.items()},
    "heat": HeatSettings,
    "solve": SolveSettings,
    "light": LightSettings,
    "light.key": KeyLight,
    "light.lights[]": LampSettings,
    "light.environment": EnvironmentSettings,
    "output": OutputSettings,
}


def tables() -> str:
    """Markdown: one table per section with every key, its meaning, default and an example."""
    blocks = []
    for name, cls in SECTIONS.items():
        rows = [
            f"| `{key}` | {doc} | {default} | `{example}` |"
            for key, doc, default, example in _keys(cls)
        ]
        head = ["| key | meaning | default | example |", "| --- | --- | --- | --- |"]
        blocks.append("\n".join([f"### `{name}`", "", *head, *rows]))
    return "\n\n".join(blocks) + "\n"


def parameters() -> str:
    """Markdown: the material parameters that an object or part may override."""
    words = ", ".join(
        f"`{name}` ({', '.join(f'`{word}`' for word in each)})"
        for name, each in materials.WORDS.items()
    )
    names = (*materials.PARAMETERS, *materials.SCATTER, *materials.LOOKS)
    whole = ", ".join(f"`{name}`" for name in materials.WHOLE)
    return (
        f"{words}, "
        + ", ".join(f"`{name}`" for name in names)
        + f".\nOf an object only, as its parts share them: {whole}, and "
        "`temperature` at the start [degrees C], with which it softens, melts and freezes "
        f"([heat](heat.md)): of {', '.join(f'`{name}`' for name in THERMAL)}.\n"
    )


def _keys(cls: type[Any]) -> Iterator[tuple[str, str, str, str]]:
    for field in dataclasses.fields(cls):
        facts = field.metadata
        yield key_name(field), facts["doc"], _default(field), facts["example"]


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "required"
    if value is None or dataclasses.is_dataclass(value) or value in ({}, ()):
        return "-"
    shown = plain(value)
    if isinstance(shown, bool):
        return "`true`" if shown else "`false`"
    return f"`{shown}`" if not isinstance(shown, list) else f"`[{', '.join(map(str, shown))}]`"
