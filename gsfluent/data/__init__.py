"""Containers: what flows between the stages. They hold tensors and check their shapes."""

from gsfluent.data.camera import Camera, projected
from gsfluent.data.capture import Capture, View
from gsfluent.data.frame import Frame
from gsfluent.data.gaussians import (
    BACKGROUND,
    INTERIOR,
    SPRAY,
    SURFACE,
    TRANSITION,
    Gaussians,
)
from gsfluent.data.particles import Particles
from gsfluent.data.solid import Solid

__all__ = [
    "BACKGROUND",
    "INTERIOR",
    "SURFACE",
    "SPRAY",
    "TRANSITION",
    "Camera",
    "Capture",
    "Frame",
    "Gaussians",
    "Particles",
    "Solid",
    "View",
    "projected",
]
