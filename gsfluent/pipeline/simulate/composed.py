"""The grid step by step, by the composable operators: the other engine of the simulation.

For what the resident solver does not know (free bodies lighter than what they meet), and to compare
it with. A step is p2g, grid update, g2p and the return
map; the contact pass is left out while no two fields meet, and the search for blocks while the old
ones hold every point.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Particles
from gsfluent.materials import BREAKS, LAWS
from gsfluent.ops.damage import DamageField
from gsfluent.ops.plasticity import INSTANT, unloading_share, weakened
from gsfluent.pipeline.colliders.blades import BladeSet
from gsfluent.pipeline.colliders.proximity import proximity_pairs
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, at_rows
from gsfluent.pipeline.simulate.engine import Counters, Points, SolverOptions, Unhealthy
from gsfluent.scene.scene import Scene

FIELDS = 8
"""Fields this engine can afford: each one has every node."""
GRADIENT_LIMIT = 0.3
"""Largest ``dt |grad v|`` of intact matter in one step."""
REFRESH = 5
"""Steps between two looks at speeds and stiffness (each one waits for the device)."""


class Composed:
    """The composed operators; arguments as :class:`.resident.Resident`."""

    def __init__(
        self,
        scene: Scene,
        matter: Matter,
        rigid: RigidSet,
        state: State,
        rows: Tensor | None,
        options: SolverOptions,
        dt_scale: float,
        counters: Counters,
    ) -> None:
        self.scene, self.matter, self.rigid = scene, matter, rigid
        self.options, self.dt_scale, self.counters = options, dt_scale, counters
        self._map = dict(options.return_map)
        self.points = state.particles if rows is None else state.particles.select(rows)
        self.peak, self._brittle = at_rows(state.peak, rows), at_rows(matter.brittle, rows)
        field = torch.unique(at_rows(state.field, rows), return_inverse=True)[1]
        self._unit = field.to(torch.int32)
        self._blades = BladeSet(scene, matter.dx)
        self.cut = at_rows(state.cut, rows)
        self._divide()
        self.time = state.time
        self.colliders = state.colliders
        device = self.peak.device
        self.impulse = torch.zeros(3, dtype=torch.float64, device=device)
        self.work = torch.zeros((), dtype=torch.float64, device=device)
        self.given = self.work.new_zeros(len(rigid.grips), 6)
        self._blocks: ops.Blocks | None = None
        self._travelled = self._speed = self._limit = 0.0
        self._refresh = 0
        self._proximity = False
        self._lost: Tensor | int = 0
        brittle = torch.isin(matter.law, matter.law.new_tensor([LAWS[name] for name in BREAKS]))
        self._loses = bool((matter.params[brittle, 7] > 0).any())
        self._cracks = DamageField(matter.law, matter.params, self.points.material)
        self._info = torch.zeros(4, dtype=torch.int64, device=device)
        p = self.points
        row: Tensor | None = p.material
        law, params = matter.law, matter.params
        if self._cracks.exists:
            law, params = weakened(law, params, p.material, self.peak)
            row = None
        after, alpha, self.stress, _ = ops.return_mapping(
            p.strain, p.alpha, torch.zeros_like(p.affine), law=law, params=params,
            material=row, dt=INSTANT, **self._map,
        )  # fmt: skip
        if p.viscous is not None:
            self.stress = ops.viscous_step(
                p.viscous, p.strain, p.alpha, torch.zeros_like(p.affine),
                (after, alpha, self.stress), law=matter.law, params=matter.params,
                material=p.material, dt=0.0,
            )[3]  # fmt: skip

    def advance(self, until: float, steps: int) -> int:
        """See :class:`gsfluent.pipeline.simulate.engine.Engine`."""
        done = 0
        while self.time < until and done < steps:
            if self._refresh <= 0:
                self._look()
                self._refresh = REFRESH
            self._refresh -= 1
            left = until - self.time
            dt = min(self._limit * self.dt_scale, left)
            if dt < left < 2.0 * dt:  # two even steps instead of a whole one and a sliver
                dt = 0.5 * left
            self._step(dt)
            self.time = until if dt == left else self.time + dt
            done += 1
        c = self.counters
        c.plastic += int(self._info[0])
        c.guarded += int(self._info[1])
        c.inverted += int(self._info[2])
        self._info = torch.zeros_like(self._info)
        lost, self._lost = int(self._lost), 0
        if lost:
            bad = ~torch.isfinite(self.points.velocity).all(dim=1)
            raise Unhealthy(
                f"{lost} points were not finite or left the grid",
                bad if bool(bad.any()) else None,
                time=self.time,
            )
        return done

    @property
    def blocks(self) -> int:
        """Blocks of the grid in use."""
        return 0 if self._blocks is None else self._blocks.block_count

    def read(self) -> Points:
        """See :class:`gsfluent.pipeline.simulate.engine.Engine`."""
        p = self.points
        return Points(
            p.position.to(torch.float64), p.velocity, p.affine, p.strain, p.alpha, self.peak,
            p.deformation, p.viscous,
        )  # fmt: skip

    def _look(self) -> None:
        """Read speeds and stiffness; choose the time step and the parameters of the return map."""
        matter, p, peak = self.matter, self.points, self.peak
        speed = p.velocity.norm(dim=1).max()
        wave = ops.wave_speed(
            p.strain, law=matter.law, params=matter.params, material=p.material
        ).max()
        # Broken points carry no stress, so how fast they are torn does not matter.
        turn = torch.linalg.matrix_norm(p.affine)
        gradient = torch.where(peak < 0, turn, torch.zeros_like(turn)).max()
        driven = self.rigid.speed(self.colliders).to(speed)
        driven = driven.clamp(min=self._blades.speed(self.time))
        looked = torch.stack([torch.maximum(speed, driven), wave, gradient])
        self._speed, fastest, steepest = looked.tolist()
        if not (self._speed < 1e6 and fastest < 1e6):
            bad = ~torch.isfinite(p.velocity).all(dim=1) | ~torch.isfinite(p.strain).all(dim=1)
            raise Unhealthy(
                f"speed {self._speed:.3g} m/s, wave speed {fastest:.3g} m/s is not finite",
                bad if bool(bad.any()) else None,
            )
        step = self.options.cfl * matter.dx / (fastest + self._speed)
        if steepest > 0:
            # The floor of a quarter keeps one wild point from freezing the whole scene.
            step = max(min(step, GRADIENT_LIMIT / steepest), 0.25 * step)
        self._limit = step
        self._row: Tensor | None = p.material
        self._params, self._law = matter.params, matter.law
        if self._cracks.exists or (self.options.irreversible and bool((peak > 0).any())):
            self._law, self._params = weakened(matter.law, matter.params, p.material, peak)
            self._row = None

    def _step(self, dt: float) -> None:
        dx, p = self.matter.dx, self.points
        # The speed may grow between two looks; a quarter more covers it.
        reach = 1.25 * self._speed * dt + 10.0 * dt * dt
        blocks = self._blocks
        if blocks is None or blocks.expired(self._travelled + reach, dx):
            blocks = self._build()
        self._travelled += reach
        rows = self._cut(dt)
        several = self._proximity or self._merged is not None
        body = self._body if several else None
        grid, moments = ops.p2g(
            p.position, p.velocity, p.affine, p.mass,
            dx=dx, blocks=blocks, dt=dt, stress=self.stress, volume=p.volume,
            body=body, fields=self._fields if several else 1, contact=several,
        )  # fmt: skip
        velocity_grid, impulse, torque, nodes = ops.grid_update(
            grid, dx=dx, dt=dt, blocks=blocks, gravity=self.scene.gravity,
            colliders=rows.to(grid.dtype), sdf=self.rigid.sdf, moments=moments,
            merged=self._merged if several else None, cut=self._sides if several else None,
            friction=self.scene.friction, return_torque=True,
        )  # fmt: skip
        position, velocity, affine, deformation, skipped = ops.g2p(
            velocity_grid, p.position, dx=dx, dt=dt, blocks=blocks, body=body,
            deformation=p.deformation, velocity=p.velocity, return_skipped=True,
        )  # fmt: skip
        if self._cracks.exists:
            self.peak = self._cracks.step(
                p.alpha, self.peak, p.position, p.volume, dx=dx, blocks=blocks, body=body
            )
            self._law, self._params = weakened(
                self.matter.law, self.matter.params, p.material, self.peak
            )
        strain, alpha, self.stress, info = ops.return_mapping(
            p.strain, p.alpha, dt * affine,
            law=self._law, params=self._params, material=self._row, dt=dt, **self._map,
        )  # fmt: skip
        viscous = p.viscous
        if viscous is not None:
            viscous, strain, alpha, self.stress = ops.viscous_step(
                viscous, p.strain, p.alpha, dt * affine, (strain, alpha, self.stress),
                law=self.matter.law, params=self.matter.params, material=p.material, dt=dt,
            )  # fmt: skip
        if self._loses:
            share = unloading_share(
                self.stress, affine, law=self.matter.law, params=self.matter.params,
                material=p.material, dx=dx,
            )  # fmt: skip
            self.stress = self.stress * share[:, None]
        self.points = p.replace(
            position=position, velocity=velocity, affine=affine, deformation=deformation,
            strain=strain, alpha=alpha, viscous=viscous,
        )  # fmt: skip
        grown = self._cracks.grown(self.peak, alpha)
        self.peak = torch.where(self._brittle, grown, self.peak)
        if impulse.numel():
            self.impulse = self.impulse + impulse.sum(dim=0)
        self.work = self.work + self.rigid.work(rows, impulse, torque)
        if grips := self.rigid.grips:
            self.given = self.given + torch.cat([impulse, torque], dim=1)[grips]
        count = self.rigid.count
        self.colliders = self.rigid.advance(
            self.colliders, self.time, dt, impulse[:count], torque[:count]
        )
        self._info += info.to(torch.int64)
        self._lost = self._lost + skipped + info[3]
        c = self.counters
        c.steps += 1
        c.composed_steps += 1
        c.particle_steps += p.count
        c.dt_min, c.dt_max = min(c.dt_min, dt), max(c.dt_max, dt)
        c.block_steps += blocks.block_count
        c.box_steps += blocks.table.numel()
        c.contact_block_steps += blocks.block_count if several else 0
        c.contact_steps += several
        c.contact_nodes += int(nodes) if several else 0

    def _build(self) -> ops.Blocks:
        """Find the active blocks anew and decide whether the contact pass is needed."""
        p: Particles = self.points
        try:
            blocks = ops.build_blocks(p.position, self.matter.dx)
        except ValueError as error:
            raise Unhealthy(str(error), kind="far") from error
        self._blocks, self._travelled = blocks, 0.0
        self.counters.block_builds += 1
        self.counters.blocks_max = max(self.counters.blocks_max, blocks.block_count)
        # Kernel reach of both (2 x 1.5) plus the slack of the blocks on both sides.
        self._proximity = self._fields > 1 and (
            not self.options.contact_proximity
            or proximity_pairs(p.position, self._unit, 4.0 * self.matter.dx).shape[0] > 0
        )
        return blocks

    def _cut(self, dt: float) -> Tensor:
        """Let the blades part what they pass in a step; return all collider rows."""
        blades, now = self._blades, self.time + dt
        if not blades.moving(self.time, now):
            return self.colliders
        cut = blades.look(self.points.position, self.cut, self.time, now)
        if not torch.equal(cut, self.cut):
            self.cut = cut
            self._divide()
        return torch.cat([self.colliders, blades.faces(now).to(self.colliders)])

    def _divide(self) -> None:
        """Number the fields: pieces, and in a piece that is being cut its sides."""
        self._body, self._merged, self._sides = self._unit, None, None
        self._fields = int(self._unit.max()) + 1
        if len(self._blades):
            fields = self._blades.fields(self._unit, self.cut)
            if bool((fields.cut != 0).any()):
                self._body, self._fields = fields.field, fields.total
                self._merged, self._sides = fields.merged, fields.cut
        self.counters.fields_max = max(self.counters.fields_max, self._fields)
