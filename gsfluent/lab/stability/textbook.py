"""The textbook solver (:mod:`gsfluent.lab.textbook.solver`) under the same watch as gsfluent's."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.shapes import free
from gsfluent.lab.stability.maps import Outcome, Place
from gsfluent.lab.stability.scenes import DX
from gsfluent.lab.textbook.solver import Textbook, Variant
from gsfluent.lab.world.invariants import Limits, State, first_violation, observe


def scene_of(
    points: Tensor,
    velocity: Tensor,
    volume: float,
    material: Mapping[str, Any],
    dx: float = DX,
    **more: Any,
) -> Scene:
    """A scene of one material that is run by steps: its times are not used."""
    x, v, each = points.double().numpy(), velocity.double().numpy(), np.full(len(points), volume)
    return free("stability", x, v, dx, 8, np.array([1.0]), material, volume=each, **more)


class OfTextbook:
    """A textbook run to be watched.

    It does not say what colliders gave, so that with colliders its momentum cannot be judged.
    """

    def __init__(self, solver: Textbook) -> None:
        self.solver = solver
        rows = []
        for m in solver.scene.materials:
            young, nu = float(m["young_modulus"]), float(m["poisson_ratio"])
            moduli = [young / (2.0 + 2.0 * nu), young / (3.0 - 6.0 * nu)]
            rows.append([*moduli, 0.0, 0.0, 0.0, 0.0, float(m["density"]), 0.0])
        where = solver.device
        self._params = torch.tensor(rows, dtype=torch.float64, device=where)
        number = 6 if solver.variant.law == "corotated" else 0
        self._law = torch.full((len(rows),), number, dtype=torch.int32, device=where)
        self._start: State | None = None
        self._start = self.look()

    def advance(self, steps: int) -> None:
        """Go on by a number of steps."""
        self.solver.run(steps=steps)

    def look(self) -> State:
        """Sum up this moment."""
        s = self.solver
        inside_out = int((s.volume_ratio <= 0).sum())  # b alone does not tell
        return observe(
            step=s.steps, time=s.time, dx=s.scene.dx, position=s.position, velocity=s.velocity,
            affine=s.affine, mass=s.mass, volume=s.volume, law=self._law, params=self._params,
            material=s.material.int(), strain=s.strain, gravity=s.scene.gravity,
            start=self._start, pulled_back=inside_out,
        )  # fmt: skip

    def save(self) -> tuple[dict[str, Any], Tensor]:
        """Copy all that changes."""
        values = {
            k: v.clone() if isinstance(v, Tensor) else copy.copy(v)
            for k, v in self.solver.__dict__.items()
            if k not in ("scene", "variant", "_turn")
        }
        return values, self.solver._turn.get_state()

    def load(self, saved: tuple[dict[str, Any], Tensor]) -> None:
        """Go back."""
        values, turn = saved
        self.solver.__dict__.update(
            {k: v.clone() if isinstance(v, Tensor) else v for k, v in values.items()}
        )
        self.solver._turn.set_state(turn)


def watched_textbook(
    scene: Scene,
    steps: int,
    place: Place,
    *,
    dt: float | None = None,
    limits: Limits | None = None,
    **options: Any,
) -> Outcome:
    """Run a scene by a variant of the textbook solver under watch."""
    solver = Textbook(
        scene, Variant(**options), device=place.device, dtype=torch.float32, dt=dt, cfl=0.5
    )  # fmt: skip
    found = first_violation(OfTextbook(solver), steps, limits=limits, every=place.every)
    return Outcome(steps, found, scene.count)
