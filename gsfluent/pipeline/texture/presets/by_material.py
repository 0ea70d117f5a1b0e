"""What a material looks like inside when nobody has shown it: preset by name of the material."""

from __future__ import annotations

PLAIN = "plain"
"""For materials without a look of their own inside: the skin's colour, a little uneven."""

_INSIDE = {
    "fruit.watermelon": "watermelon",
    "fruit.apple": "apple",
    "fruit.orange": "orange",
    "fruit.pumpkin": "pumpkin",
    "glass": "clear",
    "ice": "clear",
    "ceramic": "ceramic",
    "egg": "egg",
    # what is scanned is dry; ``bone`` has marrow
    "bone": "dry_bone",
    "chocolate": "chocolate",
    "bread": "bread",
    "plush": "stuffing",
    "concrete": "concrete",
    "rock": "stone",
    "wood": "wood",
    "plaster": "plaster",
    "foam": "foam",
    **dict.fromkeys(("snow", "sand", "gravel", "soil"), "grain"),
}


def inside_of(material: str) -> str:
    """Name of the procedural preset for the inside of a material preset."""
    return _INSIDE.get(material, PLAIN)
