"""Plastic work of a run, point by point."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.driver import World


class Dissipation:
    """Plastic dissipation of every point: work of the stress less what is stored [J].

    Give it to ``World.run(each=...)``. The work of a step is ``V0 tau_n : dt grad v_{n+1}``, that
    of the grid forces of that step, so that the sum closes the discrete energy balance.
    """

    def __init__(self, world: World) -> None:
        self.work = torch.zeros_like(world.position[:, 0], dtype=torch.float64)
        self._world, self._stress = world, world.stress

    def __call__(self, world: World) -> None:
        """Add the work of the step just made."""
        c, t = world.stepper.gradient, self._stress
        power = (
            t[:, 0] * c[:, 0, 0]
            + t[:, 1] * c[:, 1, 1]
            + t[:, 2] * c[:, 2, 2]
            + t[:, 3] * (c[:, 0, 1] + c[:, 1, 0])
            + t[:, 4] * (c[:, 0, 2] + c[:, 2, 0])
            + t[:, 5] * (c[:, 1, 2] + c[:, 2, 1])
        )
        self.work += (power * world.scene.volume).double() * world.dt
        self._stress = world.stress

    def of_points(self) -> Tensor:
        """Dissipated so far by each point [J], float64 [N]."""
        scene = self._world.scene
        stored = ops.elastic_energy(
            self._world.strain.double(),
            law=scene.law,
            params=scene.params.double(),
            material=scene.material,
        )
        return self.work - scene.volume.double() * stored
