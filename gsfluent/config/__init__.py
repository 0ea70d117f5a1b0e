"""The shot file: YAML in, frozen dataclasses out. docs/shot.md lists every key.

A key that is unknown, or that would do nothing, is an error that names its full path and the
nearest known key.
"""

from gsfluent.config.events import EVENTS, Bullet, Drop, Event, Throw, event_dict
from gsfluent.config.objects import ObjectSettings, Part, Select, Where
from gsfluent.config.settings import (
    FillSettings,
    KeyLight,
    LightSettings,
    OutputSettings,
    ReconstructSettings,
    SolveSettings,
    TextureSettings,
)
from gsfluent.config.shot import Shot, load_shot

__all__ = [
    "EVENTS",
    "Bullet",
    "Drop",
    "Event",
    "FillSettings",
    "KeyLight",
    "LightSettings",
    "ObjectSettings",
    "OutputSettings",
    "Part",
    "ReconstructSettings",
    "Select",
    "Shot",
    "SolveSettings",
    "TextureSettings",
    "Throw",
    "Where",
    "event_dict",
    "load_shot",
]
