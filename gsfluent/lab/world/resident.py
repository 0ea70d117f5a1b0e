"""A :class:`gsfluent.lab.world.driver.World` on the resident :class:`gsfluent.ops.Solver`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.stepper import Scene
from gsfluent.ops.plasticity import INSTANT, LAWS


def why_not(scene: Scene, forced: bool) -> str:
    """Say why the resident solver cannot run a scene; empty if it can."""
    if forced:
        return "a force changes velocities between steps"
    if any(scene.period):
        return "it has no periodic axes"
    laws = {int(law) for law in scene.law.tolist()}
    beside = {LAWS[name] for name in ("elastic", "nacc", "phase_field")}
    if LAWS["phase_field"] in laws and not laws <= beside:
        return "phase_field works beside elastic and nacc only"
    if scene.cfl > 1.0:
        return "its cfl is at most 1"
    return ""


class Resident:
    """State that lives in the solver; read in the order it was given.

    Position and strain keep the digits they have there: positions are float64 whatever the
    precision of the rest, since the solver keeps them relative to their cell.
    """

    def __init__(
        self,
        scene: Scene,
        position: Tensor,
        velocity: Tensor,
        affine: Tensor,
        strain: Tensor,
        alpha: Tensor,
        deformation: Tensor | None,
    ):
        self.scene = scene
        self.solver = ops.Solver(
            position, velocity, scene.mass, scene.volume, dx=scene.dx, law=scene.law,
            params=scene.params, material=scene.material, strain=strain, alpha=alpha,
            affine=affine, deformation=deformation, body=scene.body, gravity=scene.gravity,
            colliders=scene.colliders, friction=scene.friction, restitution=scene.restitution,
            contact_gap=scene.contact_gap, cfl=scene.cfl, dt=scene.fixed_dt,
            irreversible=scene.irreversible, frame=scene.frame, radius=scene.radius,
            viscous=scene.viscous, objects=scene.objects, flip=scene.flip, **scene.return_map,
        )  # fmt: skip
        rows = 0 if scene.colliders is None else scene.colliders.shape[0]
        self._none = torch.zeros(rows, 3, dtype=torch.float64, device=velocity.device)

    def __getattr__(self, name: str) -> Any:
        if name == "solver":  # not made yet
            raise AttributeError(name)
        return getattr(self.solver, name)

    def run(
        self, end: float | None, steps: int | None, each: Callable[[float], None] | None
    ) -> None:
        """Advance to a time or by steps; ``each`` gets the length of every step.

        Raises:
            FloatingPointError: What the solver stopped for.
        """
        try:
            if each is None:
                self.solver.advance(end, steps=steps)
                return
            left = math.inf if steps is None else steps
            if self.scene.fixed_dt is not None and end is not None:
                left = max(0, round((end - self.solver.time) / self.scene.fixed_dt))
            while left > 0 and (steps is not None or end is None or self.solver.time < end):
                before = self.solver.steps
                self.solver.advance(None if self.scene.fixed_dt else end, steps=1)
                if self.solver.steps == before:
                    return
                each(self.solver.dt)
                left -= 1
        except ops.SolverError as error:
            raise FloatingPointError(str(error)) from error

    @property
    def stress(self) -> Tensor:
        """Kirchhoff stress of the strain [Pa], without viscosity, [N, 6]."""
        scene, strain = self.scene, self.solver.strain
        result = ops.return_mapping(
            strain, self.solver.alpha, strain.new_zeros(strain.shape[0], 3, 3), law=scene.law,
            params=scene.params, material=scene.material, dt=INSTANT, **scene.return_map,
        )  # fmt: skip
        return result[2]

    @property
    def gradient(self) -> Tensor:
        """Gradient of the velocity at the nodes [1/s], [N, 3, 3]; matrices of APIC are that.

        Raises:
            NotImplementedError: Points keep a share of their own motion.
        """
        if self.scene.flip > 0.0:
            raise NotImplementedError("World: gradient with flip is known by engine='ops' alone")
        return self.solver.affine

    @property
    def impulse(self) -> Tensor:
        """Given to the bodies by each collider so far [N s], float64 [K, 3]."""
        return self.solver.impulse if self._none.shape[0] else self._none

    @property
    def info(self) -> Tensor:
        """Sums over the steps: plastic, guarded, inverted, invalid points, int64 [4]."""
        now = self.solver.counters()
        names = ("plastic", "guarded", "inverted", "invalid")
        return torch.tensor([int(now[name]) for name in names])
