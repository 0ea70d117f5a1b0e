"""The simulation stage: from a scene to frames of broken matter, with a verdict.

The material points move by MLS-MPM with APIC transfer (Hu et al. 2018; Jiang et al. 2015) and the
non-associated Cam-Clay return map; time steps are automatic. Every few steps the state is checked;
a bad state is rolled back and tried again with half the step. The verdict says whether that was
never needed (``clean``), helped (``healed``) or did not (``failed``).
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.data import Gaussians, Particles
from gsfluent.errors import InputError
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.cracks.gaps import Cracks
from gsfluent.pipeline.cracks.stage import METHODS, CrackHistory, Repair, Repaired
from gsfluent.pipeline.heat.ladder import thawing
from gsfluent.pipeline.liquid.parts import LiquidParts
from gsfluent.pipeline.matter.carry import Carry, Motion, Points
from gsfluent.pipeline.matter.fragments import Fragments
from gsfluent.pipeline.matter.points import (
    ALPHA_JITTER,
    MAX_PARTICLES,
    Matter,
    build_matter,
    grid_spacing,
)
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Hook, Run
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress
from gsfluent.results.behind import held_here
from gsfluent.scene.scene import Scene

_log = logging.getLogger(__name__)

QUALITY = {"preview": 20, "shot": 40, "hero": 64}
"""Cells along the longest side of the largest solid."""
RENAMED = {"contact_near": "contact_proximity"}
"""Options under their names of before, which :class:`Simulate` still takes."""
DROPPED = ("loose_debris", "loose_crumbs")
"""Options of before, which :class:`Simulate` still takes but which do nothing now."""


@dataclasses.dataclass(frozen=True, eq=False)
class SimulationFrame:
    """One frame.

    Args:
        index: Frame number, from 0.
        time: Time [s], exactly ``index / fps``.
        particles: The material points.
        damage: Damage of each point, 0 intact to 1 broken, [N]; 0 where the law has no damage.
        fragments: Piece of each point, of broken ones, too, int32 [N]; -1 for loose matter and for
            what flows (see :class:`Fragments`).
        energy: ``kinetic``, ``elastic``, ``dissipated``, ``gravity`` [J]; of phase-field matter
            also ``surface``, what its cracks cost.
        stats: The figures of run.json's ``per_frame`` for this frame.
        pieces: Sizes of the pieces.
        broken: Points that ever broke, bool [N].
        rigid: The rigid colliders of the scene.
        colliders: Their rows now, float64 [M, 32].
    """

    index: int
    time: float
    particles: Particles
    damage: Tensor
    fragments: Tensor
    energy: dict[str, float]
    stats: dict[str, Any]
    pieces: Fragments
    broken: Tensor
    rigid: RigidSet
    colliders: Tensor
    _history: CrackHistory | None = None
    _points: Points | None = None
    _cracks: Cracks | None = None

    def _binding(self) -> CrackHistory:
        if self._history is None:
            raise InputError("frame: this run carries no splats", hint="Simulate(splats=True)")
        return self._history

    @property
    def _carry(self) -> Carry:
        """The binding of the splats as it was at this moment."""
        return self._binding().carry if self._cracks is None else self._cracks.carry

    @property
    def _rest(self) -> Gaussians | None:
        """The splats at rest, cut at cracks."""
        return None if self._cracks is None else self._cracks.rest

    @property
    def led(self) -> tuple[Tensor, Tensor] | None:
        """Points whose matter is drawn elsewhere than they are, with its chunk, and where.

        Rows int32 [K] and places [m], [K, 3]; None where all are drawn where they are.
        """
        if self._points is None:
            return None
        places = self._points.position
        if self._cracks is not None and self._cracks.lent is not None:
            rows, there = self._cracks.lent
            places = places.index_copy(0, rows, there.to(places))
        rows = (places != self.particles.position.to(places)).any(dim=1).nonzero()[:, 0]
        return (rows.to(torch.int32), places[rows]) if rows.numel() else None

    @property
    def dust(self) -> Tensor | None:
        """Points that are drawn as dust, int32 [D]; None where there are none."""
        if self._cracks is None or self._cracks.dust is None:
            return None
        return self._cracks.dust.to(torch.int32)

    @functools.cached_property
    def repaired(self) -> Repaired:
        """The splats of this moment in scene coordinates, carried and repaired (made when asked).

        Splats of all bodies follow each other in the order of the scene; transition splats come
        last.
        """
        history = self._binding()
        return history.repair(
            self._carry, self.motion, self.carried, history=history, cracks=self._cracks
        )

    @property
    def liquid(self) -> LiquidParts | None:
        """What of the solids is liquid from the start; None without any."""
        return self._binding().liquid

    @property
    def gaussians(self) -> Gaussians:
        """The splats of :attr:`repaired`."""
        return self.repaired.gaussians

    @property
    def groups(self) -> Tensor:
        """Sibling groups of :attr:`gaussians` for the rasterizer, int32; -1 for none."""
        return self.repaired.groups

    @functools.cached_property
    def carried(self) -> Gaussians:
        """The splats without repair: one for one those of the solids."""
        return self._carry.apply(self.motion, self._rest)

    @functools.cached_property
    def motion(self) -> Motion:
        """Where each splat has gone."""
        carry = self._carry
        assert self._points is not None  # with the binding
        return carry.follow(self._points, self._rest)


@dataclasses.dataclass(frozen=True, eq=False)
class Moment:
    """A frame that has been reached and is not wrapped up yet, while the run may go on.

    Args:
        frame: Wraps it up. From any thread, once for each frame and in their order, because the
            repair of cracks remembers what came before.
        save: Writes the state of this moment to a file, after ``frame`` and before that of the
            next one (:meth:`Simulation.save`).
    """

    frame: Callable[[], SimulationFrame]
    save: Callable[[str | Path], None]


class Simulation(Iterator[SimulationFrame]):
    """A scene that is being simulated; iterate over it for its frames.

    When the run cannot be healed the iteration ends early; :attr:`report` has the verdict.

    Args:
        run: The run, at the frame to go on with.
        count: Number of frames.
        history: The splats and their cracks; None to carry none.
        step_hook: See :class:`Simulate`.
        progress: Told after each frame.
    """

    def __init__(
        self,
        run: Run,
        count: int,
        history: CrackHistory | None,
        step_hook: Hook | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.run, self.count, self.history = run, count, history
        self._hook, self._progress = step_hook, progress

    def __next__(self) -> SimulationFrame:
        """Simulate up to the next frame."""
        moment = self.advance()
        if moment is None:
            raise StopIteration
        return moment.frame()

    def advance(self) -> Moment | None:
        """Simulate up to the next frame without wrapping it up; None where there is none."""
        run, history = self.run, self.history
        index = run.next_frame
        with torch.no_grad():
            if index >= self.count or run.failure or not run.advance_to(index, self._hook):
                return None
            frame = moment_of(run, index, history)
        report_progress(self._progress, index + 1, self.count, f"t = {index / run.fps:.3f} s")
        kept = run.kept()
        return Moment(frame, lambda path: kept(path, self._repair_state()))

    def save(self, path: str | Path) -> None:
        """Write the state of the last frame, to be given to ``resume`` of :class:`Simulate`.

        Raises:
            InputError: Nothing has been simulated yet.
        """
        if self.run.next_frame == 0:
            raise InputError("simulate: there is no frame to save", hint="take a frame first")
        self.run.save(path, self._repair_state())

    def _repair_state(self) -> dict[str, Any]:
        return {} if self.history is None else self.history.state()

    @property
    def report(self) -> dict[str, Any]:
        """The section ``simulation`` of run.json, plus ``verdict`` and ``reason``."""
        return self.run.report()


class Simulate(Stage):
    """Simulates a scene: the call gives a :class:`Simulation`, iterate over that for the frames.

    Args:
        quality: ``preview``, ``shot`` or ``hero``: 20, 40 or 64 cells along the largest solid.
        dx: Grid spacing [m]; overrides ``quality``.
        seed: Seed of point positions and weakness, in object space.
        device: Where to compute; where the first solid is when absent.
        jitter: Relative half-width of the noise on ``alpha0``.
        repair: How ``frame.gaussians`` get splats along cracks: a method of
            :class:`gsfluent.pipeline.Repair`; True for its default, False for ``none``.
        splats: Track the total deformation, which splats and ``frame.gaussians`` need.
        max_particles: Refuse scenes with more material points.
        step_hook: Called with the state after every grid step; what it returns goes on. For tests
            and for forces of one's own.
        options: How the matter is moved.
        changes: Fields of :class:`SolverOptions` that differ from ``options``, for example
            ``cfl=0.3`` or ``sleep=False``.

    Raises:
        InputError: An unknown quality or a number outside its range.
    """

    name = "simulate"

    def __init__(
        self,
        quality: str = "preview",
        *,
        dx: float | None = None,
        seed: int = 0,
        device: torch.device | str | None = None,
        jitter: float = ALPHA_JITTER,
        repair: bool | str = True,
        splats: bool = True,
        max_particles: int = MAX_PARTICLES,
        step_hook: Hook | None = None,
        options: SolverOptions | None = None,
        **changes: Any,
    ) -> None:
        super().__init__(seed=seed)
        if quality not in QUALITY:
            raise InputError(
                f"simulate: unknown quality {quality!r}", hint=f"known: {', '.join(QUALITY)}"
            )
        if dx is not None and not (math.isfinite(dx) and dx > 0):
            raise InputError(f"simulate: dx must be positive, got {dx}", hint="give metres")
        self.quality, self.dx, self.device = quality, dx, device
        self.jitter, self.max_particles = jitter, max_particles
        self.splats, self.step_hook = splats, step_hook
        for old, new in RENAMED.items():
            if old in changes:
                _log.warning("simulate: %s is called %s now; the old name still works", old, new)
                changes[new] = changes.pop(old)
        for gone in DROPPED:
            if gone in changes:
                _log.warning("simulate: %s does nothing now: loose matter leaves the grid", gone)
                del changes[gone]
        self.options = dataclasses.replace(options or SolverOptions(), **changes)
        self.repair = Repair(
            repair if isinstance(repair, str) else METHODS[0] if repair else "none"
        )

    def prepare(self, scene: Scene) -> Matter:
        """Sample the material points of a scene without simulating it (for ``plan`` and tests)."""
        dx = self.dx or grid_spacing(scene, QUALITY[self.quality])
        matter = build_matter(
            scene,
            dx,
            seed=self.seed,
            jitter=self.jitter,
            device=scene.device if self.device is None else self.device,
            max_particles=self.max_particles,
            inertia=self.options.inertia,
        )
        matter = thawing(scene, matter)
        if not self.splats:
            particles = matter.particles.replace(deformation=None)
            matter = dataclasses.replace(matter, particles=particles)
        return matter

    def forward(
        self,
        scene: Scene,
        fps: float = 30.0,
        seconds: float = 2.0,
        *,
        progress: Progress | None = None,
        resume: str | Path | None = None,
    ) -> Simulation:
        """Simulate ``round(fps * seconds)`` frames; frame k is at time ``k / fps``.

        Args:
            scene: What to simulate.
            fps: Frames per second.
            seconds: Length.
            progress: Told after each frame.
            resume: File of :meth:`Simulation.save`; frames up to that one are not yielded again.

        Raises:
            InputError: An empty scene, bad numbers, or a resume file of another scene.
        """
        if not (math.isfinite(fps) and fps > 0 and math.isfinite(seconds) and seconds >= 0):
            raise InputError(
                f"simulate: fps and seconds must be positive, got {fps} and {seconds}",
                hint="for example fps=30, seconds=2",
            )
        count = max(1, round(fps * seconds))
        run = self.run_of(scene, fps)
        saved = {} if resume is None else run.resume(resume)
        history = None
        if self.splats:
            history = self.repair.begin(Carry.bind(scene, run.matter))
            history.restore(saved)
        return Simulation(run, count, history, self.step_hook, progress)

    def run_of(self, scene: Scene, fps: float) -> Run:
        """A run of a scene at time 0, to be advanced by hand."""
        return Run(scene, self.prepare(scene), fps, self.options)


def frame_of(
    run: Run, index: int, history: CrackHistory | None, time: float | None = None
) -> SimulationFrame:
    """Measure the present state of a run and wrap it up as a frame (``time``: index / fps)."""
    return moment_of(run, index, history, time)()


@torch.no_grad()
def moment_of(
    run: Run, index: int, history: CrackHistory | None, time: float | None = None
) -> Callable[[], SimulationFrame]:
    """Measure the present state of a run; what is returned wraps it up (:func:`frame_of`)."""
    time = index / run.fps if time is None else time
    now, pieces, stats = run.record(index, time)
    state, matter, rigid = run.state, run.matter, run.stepper.rigid
    units = run.units if history is not None else None

    @torch.no_grad()
    def wrap() -> SimulationFrame:
        held_here(state, pieces, units)
        peak, start, broken = state.peak, matter.particles.alpha, state.ever
        damage = torch.where(start < 0, 1.0 - peak / start.clamp(max=-1e-6), (peak >= 0).to(peak))
        damage = torch.where(broken, 1.0, torch.where(matter.brittle, damage, 0.0))
        particles, points, cracks = state.particles, None, None
        if history is not None and particles.deformation is not None:
            points = Points.of(
                particles.position, particles.deformation, pieces.labels, broken, units
            )
            cracks = history.step(points)
            points = points if cracks is None else cracks.points
        return SimulationFrame(
            index=index,
            time=time,
            particles=particles,
            damage=damage.clamp(0.0, 1.0),
            fragments=pieces.labels,
            energy={
                "kinetic": now.kinetic,
                "elastic": now.elastic,
                "dissipated": stats["dissipated"],
                "gravity": now.gravity,
                **({"surface": now.surface} if matter.has_field else {}),
            },
            stats=stats,
            pieces=pieces,
            broken=broken,
            rigid=rigid,
            colliders=state.colliders,
            _history=history,
            _points=points,
            _cracks=cracks,
        )

    return wrap
