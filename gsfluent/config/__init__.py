"""The shot file: YAML in, frozen dataclasses out. docs/guide/shot-keys.md lists every key.

A key that is unknown, or that would do nothing, is an error that names its full path and the
nearest known key.
"""

from gsfluent.config.colliders import COLLIDERS, ColliderSettings, collider_dict
from gsfluent.config.events import (
    EVENTS,
    Blade,
    Bullet,
    Collide,
    Drop,
    Event,
    Pour,
    Press,
    Throw,
    event_dict,
)
from gsfluent.config.objects import ObjectSettings, Part, Select, Where
from gsfluent.config.settings import (
    FillSettings,
    OutputSettings,
    ReconstructSettings,
    TextureSettings,
)
from gsfluent.config.settings_light import (
    EnvironmentSettings,
    KeyLight,
    LampSettings,
    LightSettings,
)
from gsfluent.config.settings_solve import SolveSettings
from gsfluent.config.shot import Shot, load_shot

__all__ = [
    "COLLIDERS",
    "EVENTS",
    "Blade",
    "Bullet",
    "Collide",
    "ColliderSettings",
    "Drop",
    "EnvironmentSettings",
    "Event",
    "FillSettings",
    "KeyLight",
    "LampSettings",
    "LightSettings",
    "ObjectSettings",
    "OutputSettings",
    "Part",
    "Pour",
    "Press",
    "ReconstructSettings",
    "Select",
    "Shot",
    "SolveSettings",
    "TextureSettings",
    "Throw",
    "Where",
    "collider_dict",
    "event_dict",
    "load_shot",
]
