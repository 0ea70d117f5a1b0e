"""One run of a simulation: its state, frames, records and verdict."""

from __future__ import annotations

import copy
import dataclasses
import math
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.colliders.grips import strongest
from gsfluent.pipeline.heat.looks import Heat
from gsfluent.pipeline.liquid.nozzle import pours
from gsfluent.pipeline.matter.carry import STRETCH
from gsfluent.pipeline.matter.fields import breakable, cut_bodies
from gsfluent.pipeline.matter.fragments import Fragments, rest_links
from gsfluent.pipeline.matter.pieces import Pieces, Web, find_pieces, stiff
from gsfluent.pipeline.matter.points import POINTS_PER_CELL, Matter
from gsfluent.pipeline.matter.state import State, load_state, save_state
from gsfluent.pipeline.matter.weld import seen, weld
from gsfluent.pipeline.simulate.engine import Counters, SolverOptions, Unhealthy
from gsfluent.pipeline.simulate.groups import grid_mask
from gsfluent.pipeline.simulate.health import CHECK_EVERY, Figures, Ledger, Watch, figures_of
from gsfluent.pipeline.simulate.impulse import Impulses
from gsfluent.pipeline.simulate.step import Stepper
from gsfluent.scene.scene import Scene

MOMENTUM_BAR = 1e-4
"""Relative error of the momentum balance that a run should stay below."""
REGROUP = 128
"""Grid steps between two looks for new pieces within a frame."""
RARELY, MANY = 384, 500
"""Such a look is due when a 500th of the points has broken since the last one, or after 384 steps
when any has: on a GPU a look takes as long as a hundred steps, and what few points hold together
can wait."""
MOVED = 0.25
"""Cells that something must have moved for such a look: pieces that have not parted need none, and
stiff things take thousands of steps for that."""
LOOKS = 240.0
"""Looks for new pieces, and for what may leave the grid, in a simulated second at most."""
Hook = Callable[[State], State]


class Run:
    """Advances a scene from frame to frame.

    Args:
        scene: The scene.
        matter: Its material points.
        fps: Frames per second.
        options: How; the defaults when absent.
    """

    def __init__(
        self,
        scene: Scene,
        matter: Matter,
        fps: float,
        options: SolverOptions | None = None,
    ) -> None:
        self.fps = fps
        self.stepper = Stepper(scene, matter, options)
        self._set(scene, matter)
        device = matter.particles.device
        links = rest_links(matter.rest, matter.ranges, matter.spacing).to(device)
        # each end's rows one after the other: every look gathers by them
        self.links = links.t().contiguous().t()
        self.state = self.heat.begun(self.stepper.initial(self.links.shape[0]))
        self.figures = figures_of(matter, self.state, scene.gravity)
        self.start = self.figures
        self.watch = Watch(
            matter, scene.gravity, self.start,
            max_rollbacks=self.stepper.options.max_rollbacks,
            names=[body.name for body in scene.bodies],
        )  # fmt: skip
        held = [body.start if body.held and not pours(body) else 0.0 for body in scene.bodies]
        self.ledger = Ledger(matter, scene.gravity, self.start, held)
        self.ledger.held += self.stepper.liquids.held()
        self.per_frame: list[dict[str, Any]] = []
        self.seconds = 0.0
        self.failure = ""
        self._pieces: tuple[State, Pieces] | None = None
        self._gripped = self.state.time, self.state.given

    def _set(self, scene: Scene, matter: Matter) -> None:
        self.scene, self.matter = scene, matter
        self.impulses = Impulses(scene, matter)
        self.heat = Heat(scene, matter)
        self._breakable = breakable(matter)
        # What flows runs apart and together again: it has no pieces.
        self._flowing = matter.of_law("fluid", "drucker_prager")
        device = matter.particles.device
        shares = [body.material.dust for body in scene.bodies]
        self._dust = torch.tensor(shares, dtype=torch.float64, device=device)
        self._stiff = torch.tensor([stiff(body.material) for body in scene.bodies], device=device)
        self._spacing = torch.tensor(matter.spacing, dtype=torch.float64, device=device)
        self._whole: Web | None = None

    def fit(self, scene: Scene, matter: Matter) -> None:
        """Go on with another scene and its matter; see :mod:`gsfluent.pipeline.simulate.grow`."""
        self.stepper = self.stepper.successor(scene, matter)
        self._set(scene, matter)
        self._pieces = None
        self.watch.matter, self.watch.names = matter, [body.name for body in scene.bodies]

    def twin(self) -> Run:
        """A run of its own that goes on from here."""
        other = copy.copy(self)
        other.per_frame = list(self.per_frame)
        other.watch, other.ledger = self.watch.twin(), copy.copy(self.ledger)
        other.ledger.held = list(self.ledger.held)
        other.stepper = self.stepper.successor(self.scene, self.matter)
        other.stepper.counters = dataclasses.replace(self.stepper.counters)
        return other

    @property
    def next_frame(self) -> int:
        """Number of the first frame that has not been made."""
        return len(self.per_frame)

    def advance_to(self, frame: int, hook: Hook | None, time: float | None = None) -> bool:
        """Advance to the time of a frame; return False when the run had to be given up.

        Args:
            frame: Its number.
            hook: See :class:`gsfluent.pipeline.Simulate`.
            time: Its time [s]; ``frame / fps`` when absent.
        """
        begun = clock.perf_counter()
        state, stepper, watch = self.state, self.stepper, self.watch
        until = frame / self.fps if time is None else time
        # A frame is a clean start: what follows does not depend on what was cached before it, so a
        # resumed run repeats the same numbers, and no roll-back goes behind a frame handed out.
        stepper.reset()
        # With many frames a second not each of them is worth a look.
        ticks = [math.floor(LOOKS * t + 1e-6) for t in (state.time, until)]
        if ticks[0] != ticks[1] or until <= state.time:
            state = self._regroup(state)
        state = bounded(state)
        watch.keep(state, only=True)
        checked = grouped = regrouped = state.step
        broken, looked = self._broken(state), state.time
        while state.time < until:
            trouble: Unhealthy | None = None
            try:
                left = CHECK_EVERY - (state.step - checked)
                state = self.impulses.given(state)
                stop = min(until, self.impulses.next_change(state))
                stop = min(stop, stepper.liquids.next_look(state.time))
                stop = min(stop, self.heat.next_look(state.time))
                now = stepper.advance(state, stop, 1 if hook is not None else left)
                state = now if hook is None else hook(now).adopting(now)
                state = stepper.liquids.look(state, grid_mask(state, self.matter))
                state = self.heat.look(state)
                if state.time >= until or state.step - checked >= CHECK_EVERY:
                    state = bounded(state)
                    trouble = watch.check(state, stepper)
                    checked = state.step
            except Unhealthy as error:
                trouble = error
            if trouble is not None:
                back = watch.roll_back(trouble, state, stepper)
                if back is None:
                    self.failure = watch.verdict(frame)
                    self.seconds += clock.perf_counter() - begun
                    return False
                state = back
                checked = grouped = regrouped = state.step
                looked = min(looked, state.time)
            elif state.step - grouped >= REGROUP and checked == state.step:
                grouped = state.step
                change = abs(self._broken(state) - broken)
                due = change * MANY >= len(state.peak) or state.step - regrouped >= RARELY
                if change and due and self._moved(state, looked):
                    state, looked = self._regroup(state, at_frame=False), state.time
                    regrouped = state.step
                    broken = self._broken(state)  # some may have been welded
        self.state = state
        waits = [body.held and body.start > state.time for body in self.scene.bodies]
        if watch.implausible(state, waits, self.scene.floor):
            self.failure = watch.verdict(frame)
        self.seconds += clock.perf_counter() - begun
        return not self.failure

    def _moved(self, state: State, since: float) -> bool:
        """Whether anything can have moved by a part of a cell since a time."""
        fastest = float(state.particles.velocity.norm(dim=1).max())
        return not fastest * (state.time - since) < MOVED * self.matter.dx

    def _broken(self, state: State) -> int:
        return int((state.peak >= 0).sum())

    def _web(self, state: State) -> Web:
        """What hangs together at rest, and which bodies can come apart."""
        if self._whole is None:
            p = self.matter.particles
            self._whole = Web(
                self.links, self.matter.rest, p.body.long(), self._spacing, p.mass, self._flowing,
                self._breakable, self._dust, self._stiff,
            )  # fmt: skip
        if self.scene.blades:
            may_break = self._breakable | cut_bodies(self.matter, state.cut)
            if not torch.equal(may_break, self._whole.may_break):  # else it keeps what it has found
                self._whole = dataclasses.replace(self._whole, may_break=may_break)
        return self._whole

    def _look(self, state: State) -> Pieces:
        """The pieces of a state; those of the last one asked for are kept."""
        if self._pieces is None or self._pieces[0] is not state:
            found = find_pieces(
                self._web(state),
                state.position,
                self.matter.brittle & (state.peak >= 0),
                state.cut_links,
                ever=state.ever,
                sides=state.cut if self.scene.blades else None,
                gone=state.loose & (state.unit < 0),
            )
            self._pieces = state, found
        return self._pieces[1]

    @property
    def units(self) -> Tensor:
        """What each point moves with now, int64 [N] (:class:`Pieces`)."""
        return self._look(self.state).unit

    def _regroup(self, state: State, *, at_frame: bool = True) -> State:
        """Let the stepper know what hangs together, and weld what need not be loose any more."""
        pieces = self._look(state)
        state = seen(state)
        if self.stepper.options.separate_fragments:
            state = weld(self.matter, self._web(state), state, pieces)
        return self.stepper.regroup(state, pieces, 1.0 / self.fps, at_frame=at_frame)

    def record(
        self, index: int, time: float | None = None
    ) -> tuple[Figures, Fragments, dict[str, Any]]:
        """Measure the present state and add it to the per-frame records (``time``: of it)."""
        state = self.state
        now = self.watch.figures(state)
        self.figures = now
        pieces = self._look(state).fragments
        stats = {
            "time": index / self.fps if time is None else time,
            "kinetic": now.kinetic,
            "elastic": now.elastic,
            "dissipated": self.start.total - now.total,
            "gravity": now.gravity,
            "momentum": list(now.momentum),
            "angular_momentum": list(now.angular_momentum),
            "damaged_fraction": now.damaged_fraction,
            "broken_fraction": now.damaged_fraction,
            "loose_fraction": self._loose(pieces),
            "fragments": pieces.count,
            "pieces": pieces.count,
            "pieces_over_1_percent": int((pieces.mass_fractions > 0.01).sum()),
            "active_blocks": self.stepper.blocks,
            "largest_fragment": pieces.largest,
            "fragments_over_3_percent": int((pieces.mass_fractions > 0.03).sum()),
            "alpha_max": now.alpha_max,
            "non_finite": now.non_finite,
            "momentum_error": self.ledger.error(state, now),
        }
        if self.stepper.rigid.grips:
            since, given = self._gripped
            stats["grips"] = self.stepper.rigid.reactions(
                state.colliders, state.given - given, state.time - since
            )
            self._gripped = state.time, state.given
        if heat := self.heat.figures(state):
            stats["heat"] = heat
        self.per_frame.append(stats)
        return now, pieces, stats

    def _loose(self, pieces: Fragments) -> float:
        """Share of the mass of what can break that is in no piece."""
        p = self.matter.particles
        can = self._breakable[p.body.long()] & ~self._flowing
        mass = p.mass.double()
        whole = float((mass * can).sum())
        return float((mass * (can & (pieces.labels < 0))).sum()) / whole if whole > 0.0 else 0.0

    def kept(self) -> Callable[[str | Path, dict[str, Any]], None]:
        """What writes the state of this moment, also when the run has gone on.

        It takes the file's path and the state of the repair of cracks.
        """
        state, matter = self.state, self.matter
        extra = {
            "counters": dataclasses.asdict(self.stepper.counters),
            "watch": self.watch.state(),
            "ledger": {"worst": self.ledger.worst, "scale": self.ledger.scale},
            "dt_scale": self.stepper.dt_scale,
            "field_limit": self.stepper.field_limit,
            "per_frame": list(self.per_frame),
            "seconds": self.seconds,
            "fps": self.fps,
        }
        return lambda path, repair: save_state(path, state, matter, extra | {"repair": repair})

    def save(self, path: str | Path, repair: dict[str, Any]) -> None:
        """Write the state of the last frame, and that of the repair of cracks."""
        self.kept()(path, repair)

    def resume(self, path: str | Path) -> dict[str, Any]:
        """Take up a saved run; returns the state of the repair of cracks.

        Raises:
            InputError: The file is missing, damaged, or belongs to other settings.
        """
        from gsfluent.errors import InputError

        state, extra = load_state(path, self.matter)
        if extra["fps"] != self.fps:
            raise InputError(
                f"resume: {path} was made at {extra['fps']} frames per second, not {self.fps}",
                hint="use the same fps, or start without resume",
            )
        self.state = self.heat.taken_up(state)
        self._gripped = state.time, state.given
        self.stepper.resume(Counters(**extra["counters"]))
        self.stepper.field_limit = int(extra["field_limit"])
        self.stepper.dt_scale = float(extra["dt_scale"])
        self.watch.restore(extra["watch"])
        self.ledger.worst = float(extra["ledger"]["worst"])
        self.ledger.scale = float(extra["ledger"]["scale"])
        self.per_frame = list(extra["per_frame"])
        self.seconds = float(extra["seconds"])
        return dict(extra.get("repair", {}))

    def report(self) -> dict[str, Any]:
        """Return the figures of run.json's section ``simulation``, with verdict and reason."""
        c, matter = self.stepper.counters, self.matter
        verdict = "failed" if self.failure else "healed" if self.watch.rollbacks else "clean"
        reason = self.failure or "; ".join(self.watch.reasons)
        keys = self.per_frame[0] if self.per_frame else {}
        per_frame = {key: [frame[key] for frame in self.per_frame] for key in keys}
        return {
            "verdict": verdict,
            "reason": reason,
            "frames": len(self.per_frame),
            "substeps": c.steps,
            "composed_steps": c.composed_steps,
            "dt_min": c.dt_min if c.steps else 0.0,
            "dt_max": c.dt_max,
            "dx": matter.dx,
            "particles": matter.particles.count,
            "particles_per_cell": POINTS_PER_CELL,
            "active_blocks_max": c.blocks_max,
            "active_blocks_mean": c.block_steps / max(c.steps, 1),
            "grid_points_mean": c.particle_steps / max(c.steps, 1),
            "seconds": self.seconds,
            "particle_steps_per_second": c.particle_steps / self.seconds if self.seconds else 0.0,
            "rollbacks": self.watch.rollbacks,
            "momentum_error": self.ledger.worst,
            "momentum_bar": MOMENTUM_BAR,
            "guarded_points": c.guarded,
            "inverted_points": c.inverted,
            "contact": self.stepper.options.contact,
            "contact_nodes": c.contact_nodes,
            "shared_sites_max": c.shared_sites,
            "fields_max": c.fields_max,
            "pieces_flown": c.piece_flights,
            "naps": c.naps,
            "wakes": c.wakes,
            "frozen_motion": float(self.state.dissipated),
            "skipped": {
                "free_flight_seconds": c.flight_seconds,
                "free_flight_body_steps": c.flight_body_steps,
                "piece_flight_fraction": c.flying_point_seconds / max(c.point_seconds, 1e-300),
                "sleeping_fraction": c.sleeping_point_seconds / max(c.point_seconds, 1e-300),
                "contact_steps": c.steps - c.contact_steps,
                "contact_steps_done": c.contact_steps,
                "contact_block_fraction": 1.0 - c.contact_block_steps / max(c.block_steps, 1),
                "empty_block_fraction": 1.0 - c.block_steps / max(c.box_steps, 1),
                "law_kernel_steps": c.law_kernel_steps,
                "damage_steps": c.undamaged_steps,
                "stray_points": int(self.state.loose.sum()),
                "block_searches": max(c.steps - c.block_builds, 0),
                "elastic_only_fraction": 1.0 - c.plastic / max(c.particle_steps, 1),
            },
            "grips": strongest(per_frame.get("grips", []), per_frame.get("time", [])),
            "per_frame": per_frame,
        }


WILD = 1e6
"""An entry of F at which the deformations of the state are bounded."""


LARGE = 1e3
"""Points with an entry from here on are bounded with it, so that it need not be done often."""


def bounded(state: State) -> State:
    """The state with what splats show of deformations that have run away; others stay as they are.

    A deformation that is no number any more begins again from none.
    """
    deformation = state.particles.deformation
    if deformation is None or bool((deformation.abs() < WILD).all()):
        return state
    return state._replace(particles=state.particles.replace(deformation=tamed(deformation)))


def tamed(deformation: Tensor) -> Tensor:
    """Deformations [N, 3, 3], large ones with their stretches clamped to what splats show."""
    rows = (~(deformation.abs().amax(dim=(1, 2)) < LARGE)).nonzero()[:, 0]
    # Squares of such entries are no float32.
    _, clamped = ops.polar_clamped(deformation[rows].double(), *STRETCH)
    return deformation.index_copy(0, rows, clamped.to(deformation))
