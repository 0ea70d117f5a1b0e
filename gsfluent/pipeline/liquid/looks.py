"""What is done to the liquids of a scene between steps of the grid, at looks of a fixed rate."""

from __future__ import annotations

import math

from torch import Tensor

from gsfluent.pipeline.liquid.nozzle import held_weights, release_times, waiting
from gsfluent.pipeline.liquid.spacing import apart
from gsfluent.pipeline.liquid.tearing import in_air, tears, wetted
from gsfluent.pipeline.liquid.wetting import Skin, held
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.scene.scene import Scene

TICK = 1.0 / 500.0
"""Time between two looks [s]."""
EVERY = 4
"""Looks from one at which points are pushed apart to the next."""


class Liquids:
    """The looks at a scene; without a liquid there are none.

    Args:
        scene: The scene.
        matter: Its points.
    """

    def __init__(self, scene: Scene, matter: Matter) -> None:
        self.matter = matter
        flowing = [n for n, body in enumerate(scene.bodies) if body.material.law == "fluid"]
        self._liquid = matter.of_law("fluid").nonzero()[:, 0]
        solids = [n for n, body in enumerate(scene.bodies) if body.solid is not None]
        solids = [n for n in solids if n not in flowing]
        self._skin = Skin.of(matter, solids) if flowing and solids else None
        self._solids, self._floor = wetted(matter, scene), scene.floor
        self._release = release_times(scene, matter, TICK)
        self._tears = [tears(body.material) for body in scene.bodies]
        self._active = bool(flowing)

    def held(self, first: int = 0) -> list[tuple[float, float]]:
        """What waits in nozzles, from a row on: masses [kg], and until when [s]."""
        return held_weights(self._release[first:], self.matter.particles.mass[first:])

    def begun(self, state: State) -> State:
        """The state with what waits in nozzles; of points that came later, too."""
        return waiting(state, self._release)

    def next_look(self, time: float) -> float:
        """Time of the next look [s], or infinity."""
        return (math.floor(time / TICK + 1e-6) + 1.0) * TICK if self._active else math.inf

    def look(self, state: State, on_grid: Tensor) -> State:
        """The state after a look; the same at any other time.

        Args:
            state: A state.
            on_grid: Its points on the grid, bool [N].
        """
        if not self._active or abs(state.time / TICK - round(state.time / TICK)) > 1e-6:
            return state
        out = (state.group < -1) & (self._release <= state.time + 0.5 * TICK)
        if bool(out.any()):
            state = state._replace(group=state.group.masked_fill(out, -1))
        rows = self._liquid[on_grid[self._liquid]]
        if round(state.time / TICK) % EVERY == 0 and rows.numel():
            state = self._spaced(state, rows)
        if self._skin is not None:
            state = held(state, self._skin, rows, on_grid, self.matter.dx)
        return state

    def _spaced(self, state: State, rows: Tensor) -> State:
        """Points that have run together apart again, torn sheets drawn together, each liquid."""
        position = state.position.clone()
        solid = state.position[self._solids]
        bodies = zip(self.matter.ranges, self.matter.spacing, self._tears, strict=True)
        for (a, b), spacing, torn in bodies:
            mine = rows[(rows >= a) & (rows < b)]
            if mine.numel():
                place = position[mine]
                free = in_air(place, solid, spacing, self._floor) if torn else None
                position[mine] = apart(place, spacing, free)
        p = state.particles
        return state._replace(position=position, particles=p.replace(position=position.to(p.dtype)))
