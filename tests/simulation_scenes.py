"""Small scenes in which matter leaves the grid."""

from __future__ import annotations

import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.scene.scene import Scene

CLAY = materials.Material(
    "clay", law="phase_field", young_modulus=2e5, poisson_ratio=0.25, density=1200.0,
    toughness=40.0, tensile_strength=9e3, prefer="strength",
)  # fmt: skip
SOFT = materials.elastic.override(young_modulus=2e4)


def at(x: float, y: float, z: float) -> Frame:
    return Frame(torch.eye(3), torch.tensor([x, y, z]), 1.0)


def near_miss() -> Scene:
    """Two balls pass each other within two cells without a touch, then part."""
    scene = Scene(floor=None, gravity=(0, 0, 0))
    for side in (-1.0, 1.0):
        scene.add(
            ellipsoid((0.05,) * 3), SOFT, frame=at(0.08 * side, 0.065 * side, 0),
            velocity=(-2.0 * side, 0, 0), angular_velocity=(0, 0, 1.0),
        )  # fmt: skip
    return scene


def resting(second: bool) -> Scene:
    """A ball that lies on the floor; a rod falls on it later."""
    scene = Scene()
    scene.add(ellipsoid((0.05, 0.05, 0.04)), SOFT, frame=at(0, 0, 0.04))
    if second:
        scene.pour((0.01, 0, 0.3), 1.0, 0.03, duration=0.06, material=SOFT, at=1.6)
    return scene


def dropped(material: materials.Material, height: float) -> Scene:
    """A ball of 0.2 m that falls from this height."""
    scene = Scene()
    scene.add(ellipsoid((0.1, 0.1, 0.1)), material)
    scene.drop(height)
    return scene
