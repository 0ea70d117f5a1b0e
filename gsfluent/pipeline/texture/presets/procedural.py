"""Presets: interiors as functions of position and depth, no photograph needed.

Every preset is ``f(points, depth, seed) -> (rgb, key)`` with points [n, 3] centred on the object,
z along its own axis, and depth [n], both in units of the largest depth (so depth runs 0..1 from
skin to core). They are point functions: any resolution, any oblique plane, no seams.
"""

from __future__ import annotations

import numpy as np

from gsfluent.errors import check_choice
from gsfluent.pipeline.texture.presets import food, matter, plain
from gsfluent.pipeline.texture.presets.tools import Preset
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture, axis_frame

_CHUNK = 32_000
"""Points evaluated at a time: their fifty numbers each should stay in the cache."""

_FOOD = (food.apple, food.bread, food.cake, food.orange, food.watermelon)
_MATTER = (
    matter.bone,
    matter.concrete,
    matter.dry_bone,
    matter.jelly,
    matter.marble,
    matter.stuffing,
    matter.wood,
)
_PLAIN = (
    plain.ceramic,
    plain.chocolate,
    plain.clear,
    plain.egg,
    plain.foam,
    plain.grain,
    plain.plain,
    plain.plaster,
    plain.pumpkin,
    plain.stone,
)
PRESETS: dict[str, Preset] = {preset.__name__: preset for preset in (*_FOOD, *_MATTER, *_PLAIN)}


def preset_names() -> list[str]:
    """Names of the presets, sorted."""
    return sorted(PRESETS)


def check_preset(preset: str | None) -> None:
    """Raise :class:`InputError` unless there is such a preset."""
    hint = "choose one of these or give an exemplar photograph"
    check_choice("texture: preset", preset, preset_names(), hint)


def procedural_texture(domain: InteriorDomain, preset: str, seed: int) -> InteriorTexture:
    """Evaluate a preset in every inside voxel.

    Raises:
        InputError: Unknown preset.
    """
    check_preset(preset)
    index = np.argwhere(domain.inside)
    scale = max(domain.max_depth, 1.0)
    middle = 0.5 * (index.min(0) + index.max(0)) + 0.5
    frame = axis_frame(domain.axis)
    depth = domain.depth[domain.inside] / scale
    color = np.empty((len(index), 3), np.float32)
    key = np.zeros(len(index), np.int64)
    for start in range(0, len(index), _CHUNK):
        part = slice(start, start + _CHUNK)
        points = (index[part] + 0.5 - middle) / scale @ frame.T
        color[part], key[part] = PRESETS[preset](points, depth[part], seed)
    if preset in plain.TINTED:
        color *= np.median(domain.skin[domain.shell], axis=0) / plain.GREY
    rgb = np.zeros((*domain.inside.shape, 3), np.float32)
    rgb[domain.inside] = color.clip(0.0, 1.0)
    labels = np.zeros(domain.inside.shape, np.int32)
    labels[domain.inside], count = _numbered(key)
    return InteriorTexture(rgb, labels, {"preset": preset, "inclusions": count})


def _numbered(key: np.ndarray) -> tuple[np.ndarray, int]:
    """Keys replaced by 1, 2, ... in their order; 0 stays."""
    found = np.unique(key[key != 0])
    return np.where(key == 0, 0, np.searchsorted(found, key) + 1), len(found)
