"""Insides that are drawn by rule."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    by_material="PLAIN inside_of",
    procedural="PRESETS check_preset preset_names procedural_texture",
)
