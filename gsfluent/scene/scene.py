"""A scene: solids, what they are made of, where they are, how they move, and the floor.

Coordinates are SI metres with +z up. A solid is brought from its own (world) coordinates into the
scene by its ``Frame``; events then place and move it. What a scene is made of:
:mod:`gsfluent.scene.parts`; the events: :mod:`gsfluent.scene.events`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from gsfluent import materials
from gsfluent.data import Frame, Solid
from gsfluent.data.regions import require_labels
from gsfluent.errors import InputError
from gsfluent.materials import Material
from gsfluent.scene.colliders import MODES
from gsfluent.scene.events import Events
from gsfluent.scene.heat import Surroundings
from gsfluent.scene.parts import Blade, Body, Collider, Part, known_key, number, vector

__all__ = ["Blade", "Body", "Collider", "Part", "Scene"]


class Scene(Events):
    """What is simulated: bodies, the floor, gravity.

    Args:
        floor: Height of the floor [m], or None for no floor.
        gravity: Acceleration [m/s^2], [3].
        floor_friction: Coulomb friction of the floor.
        floor_mode: ``separate`` (matter may leave it), ``slip`` or ``sticky``.
        friction: Coulomb friction between bodies.
        heat: What is around bodies that have a temperature; default: still air of 20 degrees C
            and a floor that lets no heat through.
    """

    def __init__(
        self,
        floor: float | None = 0.0,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        *,
        floor_friction: float = 0.4,
        floor_mode: str = "separate",
        friction: float = 0.3,
        heat: Surroundings | None = None,
    ) -> None:
        self.floor = None if floor is None else number("floor", floor)
        self.gravity = vector("gravity", gravity)
        self.floor_friction = number("floor_friction", floor_friction, low=0.0)
        self.friction = number("friction", friction, low=0.0)
        known_key("floor_mode", floor_mode, MODES)
        self.floor_mode = floor_mode
        self.heat = heat
        super().__init__()

    @property
    def device(self) -> torch.device:
        """Where the first solid is; the CPU without one."""
        solids = (body.solid for body in self.bodies if body.solid is not None)
        return next((solid.gaussians.device for solid in solids), torch.device("cpu"))

    def add(
        self,
        solid: Solid,
        material: Material | str = "fruit.watermelon",
        *,
        frame: Frame | None = None,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        parts: Sequence[Part | Mapping[str, Any]] | None = None,
        name: str | None = None,
        temperature: float | None = None,
    ) -> str:
        """Add a filled object where its frame puts it; events move it.

        Args:
            solid: The filled object.
            material: A :class:`Material` or the name of a preset.
            frame: World to scene; default: ``solid.frame``. Without either the solid stays where
                it is, but is lifted onto the floor when it starts below it.
            velocity: Velocity of the centre of mass at time 0 [m/s].
            angular_velocity: Spin about the centre of mass at time 0 [rad/s].
            parts: Regions with parameters of their own; default: those of the material. Masks,
                labels and label images among their conditions must have been projected onto the
                solid before (:class:`gsfluent.pipeline.Regions`).
            name: Name of the body; default ``object``, ``object2``, ...
            temperature: At time 0 [degrees C]: heat flows in it, and it softens, melts and
                freezes (docs/guide/heat.md). None: heat plays no part.

        Returns:
            The name of the body.

        Raises:
            InputError: An empty solid, an unknown preset or parameter, or a name taken twice,
                or a part whose labels the solid does not have.
        """
        if not bool(solid.occupancy.any()):
            raise InputError(
                "scene.add: the solid holds no matter", hint="fill it first (gsfluent fill)"
            )
        chosen = materials.get(material) if isinstance(material, str) else material
        if temperature is not None and chosen.hysteresis == "unloading":
            # what melts has no springs yet: the loss that needs no memory
            chosen = chosen.override(hysteresis="pressed")
        regions = tuple(Part.parse(part) for part in (chosen.parts if parts is None else parts))
        for part in regions:
            part.material(
                chosen
            )  # refuse bad parameters here, where the user can see which call is meant
        placed = frame or solid.frame
        for part in regions:
            require_labels(solid, part.where, part.name)
        body = Body(
            name=self._name(name, "object"),
            material=chosen,
            solid=solid,
            frame=placed or Frame.identity(),
            parts=regions,
            velocity=vector("velocity", velocity),
            angular_velocity=vector("angular_velocity", angular_velocity),
            temperature=None
            if temperature is None
            else number("temperature", temperature, low=-273.15),
        )
        if placed is None and self.floor is not None:
            rise = self.floor - float(body.bounds()[0][2])
            body = dataclasses.replace(body, offset=(0.0, 0.0, max(rise, 0.0)))
        self.bodies.append(body)
        return body.name
