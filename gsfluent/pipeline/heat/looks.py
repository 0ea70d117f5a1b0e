"""Heat between steps of the grid: it flows at looks of a fixed rate, and points soften by it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.heat.ladder import LEVELS, at_level, thermal_of
from gsfluent.pipeline.heat.touching import groups, summed, touching, turned
from gsfluent.pipeline.matter.points import POINTS_PER_CELL, Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.scene.heat import Surroundings
from gsfluent.scene.scene import Scene

TICK = 1.0 / 60.0
"""Time between two looks [s]."""
APART = 2.0
"""Spacings beyond which two points share no heat: a crack, or melt that has flowed away."""
TOUCHES = 0.75
"""Height of a point over the floor, in spacings, at which its cell stands on it."""
SUPPLE = 0.25
"""Share of a step of softening by which a point goes past its edge before it goes back."""


class _Warm(NamedTuple):
    """A body that has a temperature."""

    name: str
    rows: slice
    links: Tensor  # pairs of its points, from 0
    rest: Tensor  # places at rest [m], and how far each is off the middle of its cell there
    jitter: Tensor
    faces: Tensor  # open faces at rest
    table: Tensor  # thermal row, [1, 7]
    start: float  # degrees C


class _Part(NamedTuple):
    """A body at a look."""

    place: Tensor  # of its points [m]
    links: Tensor  # of those near enough, from 0
    faces: Tensor  # open ones
    stands: Tensor  # whether a point stands on the floor


class _Met(NamedTuple):
    """Where two bodies touch."""

    pairs: Tensor  # points of both, from 0
    share: Tensor  # of a face


class Heat:
    """The looks at a scene; without a temperature there are none.

    Args:
        scene: The scene.
        matter: Its points, :func:`~gsfluent.pipeline.heat.ladder.thawing`.
    """

    def __init__(self, scene: Scene, matter: Matter) -> None:
        self.matter, self.around = matter, scene.heat or Surroundings()
        self.floor = scene.floor
        self.spacing = matter.dx / POINTS_PER_CELL ** (1.0 / 3.0)
        self._warm = []
        device = matter.particles.device
        for body, (a, b) in zip(scene.bodies, matter.ranges, strict=True):
            if body.temperature is None or matter.ladder is None:
                continue
            own = matter.rest[a:b].double().cpu() @ body.frame.rotation
            links, faces = ops.lattice_links(own, self.spacing)
            jitter = ops.lattice_cells(own, self.spacing)[1] @ body.frame.rotation.T
            table = thermal_of(body.name, body.material).row()[None].to(device)
            self._warm.append(
                _Warm(body.name, slice(a, b), links.to(device), matter.rest[a:b].double(),
                      jitter.to(device), faces.to(device), table, body.temperature)
            )  # fmt: skip

    def begun(self, state: State) -> State:
        """The state at time 0 with its heat."""
        if not self._warm:
            return state
        heat = torch.zeros_like(state.position[:, 0])
        for body in self._warm:
            start = torch.full_like(heat[body.rows], body.start)
            heat[body.rows] = ops.enthalpy(start, rows=body.table)
        return self._softened(state._replace(enthalpy=heat), self._level(heat, None))

    def taken_up(self, state: State) -> State:
        """A state that was read from a file, with the rows of its heat."""
        if state.enthalpy is None or not self._warm:
            return state
        assert state.level is not None
        rows = at_level(self.matter, state.level)
        return state._replace(particles=state.particles.replace(material=rows))

    def next_look(self, time: float) -> float:
        """Time of the next look [s], or infinity."""
        return (math.floor(time / TICK + 1e-6) + 1.0) * TICK if self._warm else math.inf

    def look(self, state: State) -> State:
        """The state after a look; the same at any other time."""
        if not self._warm or abs(state.time / TICK - round(state.time / TICK)) > 1e-6:
            return state
        heat = state.enthalpy
        assert heat is not None
        heat = heat.clone()
        parts = [self._part(body, state) for body in self._warm]
        met = self._met(parts)
        for group in groups(len(parts), list(met)):
            self._flow(group, parts, met, state, heat)
        return self._softened(state._replace(enthalpy=heat), self._level(heat, state.level))

    def figures(self, state: State) -> dict[str, dict[str, float]]:
        """Mean temperature [degrees C] and share of the liquid of each body, by mass."""
        found = {}
        for body in self._warm:
            assert state.enthalpy is not None
            warm, share = ops.temperature(state.enthalpy[body.rows], rows=body.table)
            mass = state.particles.mass[body.rows].double()
            mean = (torch.stack([warm, share]) * mass).sum(dim=1) / mass.sum()
            found[body.name] = {"temperature": float(mean[0]), "liquid": float(mean[1])}
        return found

    def _part(self, body: _Warm, state: State) -> _Part:
        """What a body has at a look."""
        place = state.position[body.rows]
        a, b = body.links.unbind(dim=1)
        near = (place[a] - place[b]).norm(dim=1) <= APART * self.spacing
        links = body.links[near]
        faces = 6 - torch.bincount(links.reshape(-1), minlength=len(place))
        stands = torch.zeros_like(faces, dtype=torch.bool)
        if self.floor is not None:
            stands = place[:, 2] - self.floor < TOUCHES * self.spacing
            faces = (faces - stands.long()).clamp(min=0)
        return _Part(place, links, faces.to(place), stands)

    def _met(self, parts: list[_Part]) -> dict[tuple[int, int], _Met]:
        """Where bodies touch, by their numbers."""
        met: dict[tuple[int, int], _Met] = {}
        if len(parts) < 2:
            return met
        shown, places = [], []
        for body, part in zip(self._warm, parts, strict=True):
            place, rows = part.place.double(), part.faces.nonzero()[:, 0]
            jitter = body.jitter[rows] @ turned(body.rest, place).T
            shown.append(rows)
            places.append(place[rows] - jitter)
        for b in range(len(parts)):
            for a in range(b):
                pairs, share = touching(places[a], places[b], self.spacing)
                if len(pairs):
                    ends = [shown[a][pairs[:, 0]], shown[b][pairs[:, 1]]]
                    met[a, b] = _Met(torch.stack(ends, dim=1), share)
        return met

    def _flow(
        self,
        group: list[int],
        parts: list[_Part],
        met: dict[tuple[int, int], _Met],
        state: State,
        heat: Tensor,
    ) -> None:
        """Heat of bodies that touch after a look, into ``heat``."""
        around, bodies = self.around, [self._warm[n] for n in group]
        counts = [len(parts[n].place) for n in group]
        first = dict(zip(group, [sum(counts[:i]) for i in range(len(group))], strict=True))
        faces = torch.cat([parts[n].faces for n in group])
        links = torch.cat([parts[n].links + first[n] for n in group])
        share = heat.new_ones(len(links)) if len(group) > 1 else None
        for (a, b), contact in met.items():
            if share is None or a not in first:
                continue
            pairs = contact.pairs + links.new_tensor([first[a], first[b]])
            faces = faces - summed(contact.share.repeat(2), pairs.T.reshape(-1), len(faces))
            links, share = torch.cat([links, pairs]), torch.cat([share, contact.share.to(share)])
        faces = faces.clamp(min=0.0)
        wall = None
        at = torch.cat([parts[n].stands for n in group]).nonzero()[:, 0]
        if around.floor is not None and len(at):
            wall = at, torch.full_like(heat[at], around.floor)
        number = torch.arange(len(group), dtype=torch.int32, device=heat.device)
        after = ops.conduct(
            torch.cat([heat[body.rows] for body in bodies]),
            mass=torch.cat([state.particles.mass[body.rows] for body in bodies]).double(),
            links=links, spacing=self.spacing, rows=torch.cat([body.table for body in bodies]),
            material=number.repeat_interleave(torch.tensor(counts, device=heat.device)),
            dt=TICK * around.speed, wall=wall, share=share,
            air=(faces.to(heat), around.air, around.transfer),
        )  # fmt: skip
        for body, part in zip(bodies, after.split(counts), strict=True):
            heat[body.rows] = part

    def _level(self, heat: Tensor, before: Tensor | None) -> Tensor:
        """Step of each point from solid to liquid, int8 [N]; what is near an edge stays."""
        level = torch.zeros_like(heat, dtype=torch.int8)
        for body in self._warm:
            share = ops.temperature(heat[body.rows], rows=body.table)[1] * LEVELS
            now = share.round()
            if before is not None:
                old = before[body.rows].to(share)
                now = torch.where((share - old).abs() <= 0.5 + SUPPLE, old, now)
            level[body.rows] = now.to(torch.int8)
        return level

    def _softened(self, state: State, level: Tensor) -> State:
        """The state with the rows of these levels; what changes leaves its sleep."""
        p, before = state.particles, state.level
        rows = at_level(self.matter, level)
        changed = rows != p.material
        if not bool(changed.any()):
            return state._replace(level=level if before is None else before)
        bulk = self.matter.params[:, 1]
        # What stiffens keeps its stress and not its strain, or freezing would make energy.
        ratio = (bulk[p.material.long()] / bulk[rows.long()]).clamp(max=1.0)
        strain = torch.where(changed[:, None], p.strain * ratio[:, None], p.strain)
        if before is not None:  # melt that has parted carries no tension, and must get none
            frozen = (before == LEVELS) & (level < LEVELS)
            strain = torch.where(frozen[:, None], strain.clamp(max=0.0), strain)
        bodies = torch.unique(p.body[changed & (state.group >= 0)])
        woken = torch.isin(p.body, bodies) & (state.group >= 0) & state.asleep
        return state._replace(
            particles=p.replace(material=rows, strain=strain),
            level=level,
            group=state.group.masked_fill(woken, -1),
            asleep=state.asleep & ~woken,
            calm=state.calm.masked_fill(woken, 0),
        )
