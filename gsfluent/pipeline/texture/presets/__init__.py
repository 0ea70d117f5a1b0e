"""Insides that are drawn by rule."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.texture.presets.procedural": (
            "PRESETS",
            "check_preset",
            "preset_names",
            "procedural_texture",
        ),
    },
)
