"""The shot file: YAML in, frozen dataclasses out. docs/guide/shot-keys.md lists every key.

A key that is unknown, or that would do nothing, is an error that names its full path and the
nearest known key.
"""

from gsfluent.config.colliders import COLLIDERS, ColliderSettings
from gsfluent.config.events import EVENTS, Bullet, Drop, Throw
from gsfluent.config.objects import ObjectSettings, Select
from gsfluent.config.read import typed_dict
from gsfluent.config.shot import Shot, load_shot, refuse_programs

__all__ = [
    "COLLIDERS",
    "EVENTS",
    "Bullet",
    "ColliderSettings",
    "Drop",
    "ObjectSettings",
    "Select",
    "Shot",
    "Throw",
    "load_shot",
    "refuse_programs",
    "typed_dict",
]
