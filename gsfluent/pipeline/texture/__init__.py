"""Interior texture: from a photograph, a preset, a diffusion model, or nothing but the surface."""

from __future__ import annotations

from .domain import InteriorDomain, InteriorTexture
from .photo import Exemplar, load_exemplar
from .procedural import preset_names
from .stage import METHODS, Texture

__all__ = [
    "METHODS",
    "Exemplar",
    "InteriorDomain",
    "InteriorTexture",
    "Texture",
    "load_exemplar",
    "preset_names",
]
