"""The simulation stage of a run: one file per finished frame, taken up again where it stopped."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.config import COLLIDERS, EVENTS, ColliderSettings, ObjectSettings, Shot, typed_dict
from gsfluent.data import Frame, Gaussians, Solid
from gsfluent.materials import Material
from gsfluent.pipeline.colliders.splats import bare_points, bare_splats, blade_splats, rigid_splats
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.stage import Moment, Simulate, SimulationFrame
from gsfluent.results.behind import Behind
from gsfluent.results.frames import FrameWriter, SavedFrame, count_frames, packed_frame
from gsfluent.results.partition import FILE as PARTITION
from gsfluent.results.partition import save_partition
from gsfluent.results.store import content_digest
from gsfluent.scene.heat import Surroundings
from gsfluent.scene.scene import Body, Scene
from gsfluent.stages.context import RunContext
from gsfluent.stages.findings import (
    cells_for_walls,
    lowered,
    notes_of,
    summary,
    thin_walls,
    walls_note,
)
from gsfluent.stages.solids import load_solids
from gsfluent.stages.strikes import FILE as STRIKES
from gsfluent.stages.strikes import Strikes

_log = logging.getLogger(__name__)
_STATE = "state.pt"
PATIENCE = 20.0
"""A state that took a second to write is written again after so many: a run spends a twentieth of
its time on it at most, and loses no more than that when it is stopped."""
AHEAD = 3
"""Frames that the run may be ahead of the repair of their cracks: those in which much breaks take
long. Each holds its points."""
_STEEL_ROWS = 2**40


def build_scene(shot: Shot, solids: dict[str, Solid], frame: Frame) -> Scene:
    """The scene of a shot: its solids with their materials, the floor, and the events.

    Raises:
        InputError: A material, part or event that cannot be.
    """
    scene = Scene(
        floor=None if shot.floor == "none" else 0.0,
        gravity=shot.gravity,
        floor_mode=shot.floor_mode,
        floor_friction=shot.floor_friction,
        heat=None if shot.heat is None else Surroundings(**dataclasses.asdict(shot.heat)),
    )
    for name, settings in shot.objects.items():
        parts = None if settings.parts is None else [part.to_dict() for part in settings.parts]
        scene.add(
            solids[name], _material(settings), frame=frame, parts=parts, name=name,
            temperature=settings.temperature,
        )  # fmt: skip
    if shot.floor == "auto":
        _lift(scene)
    for collider in shot.colliders:
        keys = typed_dict(collider, COLLIDERS)
        scene.add_collider(keys.pop("type"), **keys)
    for event in shot.events:
        scene.add_event(typed_dict(event, EVENTS))
    return scene


def _lift(scene: Scene) -> None:
    """Put objects on a floor that was found for them: a filled solid reaches below its splats."""
    lowest = min(float(body.bounds()[0][2]) for body in scene.bodies)
    if scene.floor is not None and lowest < scene.floor:
        scene.lift(scene.floor - lowest)


def _collider_key(collider: ColliderSettings) -> dict[str, Any]:
    """What a collider depends on: its settings, and the content of its mesh instead of its path."""
    keys = typed_dict(collider, COLLIDERS)
    if "mesh" in keys:
        keys["mesh"] = content_digest(Path(keys["mesh"]))
    return keys


def _material(settings: ObjectSettings) -> Material:
    return materials.get(settings.material).override(**dict(settings.overrides))


def _moving(settings: ObjectSettings) -> dict[str, Any]:
    """The settings of an object that a simulation hangs on: all but its highlights."""
    return {k: v for k, v in settings.to_dict().items() if k not in materials.LOOKS}


def moving_settings(shot: Shot) -> list[Any]:
    """All of a shot that its motion hangs on, but for cells and step."""
    objects = {
        # the numbers of a preset, not its name: a retuned preset is another simulation
        name: [_moving(settings), repr(_material(settings))]
        for name, settings in shot.objects.items()
    }
    return [
        objects,
        [typed_dict(event, EVENTS) for event in shot.events],
        [_collider_key(collider) for collider in shot.colliders],
        [shot.floor, shot.floor_mode, shot.floor_friction, list(shot.gravity)],
        # as it was before there was a choice, where nodes are held
        [shot.solve.standing, *([shot.solve.contact] if shot.solve.contact != "nodes" else [])],
        *([shot.solve.inertia] if shot.solve.inertia != "grid" else []),
        *([] if shot.heat is None else [dataclasses.asdict(shot.heat)]),
        shot.output.fps,
        shot.output.seconds,
    ]


def solver_options(shot: Shot) -> SolverOptions:
    """How the matter of a shot is moved."""
    solve = shot.solve
    return SolverOptions(
        cfl=solve.cfl,
        standing=solve.standing,
        deterministic=solve.deterministic,
        surface=None if solve.contact == "auto" else solve.contact == "points",
        inertia=solve.inertia == "body",
        all_devices=solve.devices == "all",
    )


def simulate_stage(context: RunContext) -> None:
    """Move the matter: ``stages/simulate/frame_0001.npz`` and so on."""
    shot = context.shot
    most = shot.solve.points_for_walls
    solve = [shot.solve.quality, shot.solve.cells, shot.solve.cfl, most]
    settings = [moving_settings(shot), solve, shot.output.cracks]

    def work(folder: Path) -> dict[str, Any]:
        scene = build_scene(shot, load_solids(context), context.frame)
        cells, quality = shot.solve.cells, shot.solve.quality
        finer = ""
        if cells is None:
            cells, wanted = cells_for_walls(scene, quality, most)
            finer = walls_note(quality, cells, wanted, most)
            if finer:
                _log.warning("%s", finer)
        stage = Simulate(
            quality=quality,
            seed=context.seed,
            device=context.device,
            dx=grid_spacing(scene, cells),
            options=solver_options(shot),
            repair=shot.output.cracks,
        )
        state = folder / _STATE
        resume = state if state.is_file() and count_frames(folder) > 0 else None
        frames = stage(
            scene,
            fps=shot.output.fps,
            seconds=shot.output.seconds,
            progress=context.reporter.task("simulate"),
            resume=resume,
        )
        # before the work: who must take a finer grid learns it while there is something to save
        thin = thin_walls(scene, frames.run.matter.dx, told=bool(finer))
        weak = lowered(scene, frames.run.matter.dx)
        for note in weak:
            _log.warning("%s", note)
        if resume is None:
            for old in (STRIKES, PARTITION):  # of other settings
                (folder / old).unlink(missing_ok=True)
        strikes = Strikes(scene, frames.run.matter, folder)
        history, written = frames.history, (-1, -1)
        assert history is not None  # a run of a shot carries splats

        def keep(ended: bool = False) -> None:
            """What is known so far, when all frames are on disk."""
            nonlocal written
            files.wait()
            strikes.keep(ended)
            partition = history.partition()
            # both only grow, and all else of it stays
            grown = (
                (-1, -1) if partition is None else (len(partition.splits), len(partition.crumbs))
            )
            if partition is not None and grown != written:
                save_partition(folder, partition)
            written = grown

        saved_at, cost = time.monotonic(), 0.0
        frame_files = FrameWriter(folder, frames.run.next_frame)

        def finish(moment: Moment) -> None:
            """Wrap up a frame, while the run goes on to the next ones."""
            nonlocal saved_at, cost
            frame = moment.frame()
            files.do(frame_files.write, frame.index, packed_frame(saved(frame, scene)))
            strikes.see(frame)
            begun = time.monotonic()
            if begun - saved_at >= PATIENCE * cost:
                keep()
                moment.save(state)
                saved_at = time.monotonic()
                cost = saved_at - begun

        with Behind() as files:
            # Small operations of two teams wait for each other's threads more than they compute.
            half = max(1, torch.get_num_threads() // 2)
            device = frames.run.matter.particles.device
            with Behind(AHEAD, device, threads=half) as repair:
                while (moment := frames.advance()) is not None:
                    repair.do(finish, moment)
            keep(ended=True)
        unbroken, report = strikes.unbroken(), frames.report
        notes = [finer] if finer else []
        notes += notes_of(thin, weak, unbroken, math.hypot(*scene.gravity))
        for note in notes[-len(unbroken) :] if unbroken else ():
            _log.warning("%s", note)
        _log.info("simulate: %s", summary(report["per_frame"]))
        return report | {"thin": thin, "unbroken": unbroken, "notes": notes}

    report = context.do("simulate", work, settings, section="simulation", scratch=(_STATE,)).report
    fill = context.record.values["fill"]
    # the number of material points is known only once the grid is
    for name in ("particles", "particles_per_cell"):
        if name in report and name not in fill:
            fill[name] = report[name]


def saved(frame: SimulationFrame, scene: Scene) -> SavedFrame:
    """What of a simulated frame goes to disk.

    Splats of the solids, then of bullets, liquids and rigid things, then transitions. What of a
    solid is liquid is drawn as one, and not by the splats that were bound to it.
    """
    repaired = frame.repaired
    gaussians, groups, ids = repaired.gaussians, repaired.groups, repaired.ids
    anchor, carried = repaired.anchor, frame.carried.count
    points = bare_points(frame.particles, scene)
    bare = bare_splats(frame.particles, scene)
    if liquid := frame.liquid:
        kept = (~liquid.holds(anchor)).nonzero()[:, 0]
        carried = int((kept < carried).sum())
        gaussians, groups = gaussians.select(kept), groups[kept]
        anchor, ids = anchor[kept], ids[kept]
        points = torch.cat([points, liquid.rows])
        inside = liquid.splats(frame.particles)
        bare = inside if bare is None else Gaussians.cat([bare, inside])
    things = [rigid_splats(frame.rigid, frame.colliders)]
    things.append(blade_splats(scene, frame.time, ids.device))
    seen = [thing for thing in things if thing is not None]
    steel = Gaussians.cat(seen) if seen else None
    for extra, follows in ((bare, points), (steel, None)):
        if extra is None:
            continue
        alone = torch.full((extra.count,), -1, dtype=torch.int64, device=ids.device)
        # those of matter by its point, those of steel beyond all of them
        numbers = torch.arange(extra.count, device=ids.device) + _STEEL_ROWS
        numbers = -1 - (numbers if follows is None else follows)
        first = torch.arange(gaussians.count, device=ids.device) < carried
        gaussians = Gaussians.cat([gaussians.select(first), extra, gaussians.select(~first)])
        groups = _insert(groups, carried, alone)
        ids = _insert(ids, carried, numbers)
        anchor = _insert(anchor, carried, alone if follows is None else follows)
        carried += extra.count
    particles = frame.particles
    waiting = [n for n, body in enumerate(scene.bodies) if _waits(body, frame.time)]
    if waiting:  # a bullet that has not been fired is not seen
        them = torch.isin(particles.body, particles.body.new_tensor(waiting))
        unseen = (anchor >= 0) & them[anchor.clamp(min=0).long()]
        gaussians = gaussians.replace(opacities=gaussians.opacities.masked_fill(unseen, 0.0))
    return SavedFrame(
        index=frame.index,
        time=frame.time,
        gaussians=gaussians,
        groups=groups,
        carried=carried,
        ids=ids,
        anchor=anchor.to(torch.int32),
        positions=particles.position,
        volumes=particles.volume,
        damage=frame.damage,
        fragments=frame.fragments,
        velocity=particles.velocity,
        body=particles.body,
        material=particles.material,
        led=frame.led,
        dust=frame.dust,
        facts=dict(frame.stats)
        | {
            "energy": dict(frame.energy),
            "bodies": [[body.name, body.material.name] for body in scene.bodies],
            "liquid_inside": list(liquid.bodies) if liquid else [],
        },
    )


def _waits(body: Body, time: float) -> bool:
    return body.held and body.length == 0.0 and body.start > time + 1e-12


def _insert(values: Tensor, row: int, more: Tensor) -> Tensor:
    return torch.cat([values[:row], more.to(values), values[row:]])
