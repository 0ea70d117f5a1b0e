"""Interior texture: from a photograph, a preset, a diffusion model, or nothing but the surface."""

from __future__ import annotations

from gsfluent.pipeline.texture.photo.exemplar import Exemplar, load_exemplar
from gsfluent.pipeline.texture.presets.procedural import preset_names
from gsfluent.pipeline.texture.stage import METHODS, Texture
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture

__all__ = [
    "METHODS",
    "Exemplar",
    "InteriorDomain",
    "InteriorTexture",
    "Texture",
    "load_exemplar",
    "preset_names",
]
