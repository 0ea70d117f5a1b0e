"""The simulation stage of a run: one file per finished frame, taken up again where it stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from gsfluent import materials
from gsfluent.config import ColliderSettings, ObjectSettings, Shot, collider_dict, event_dict
from gsfluent.data import SURFACE, Frame, Gaussians, Particles, Solid
from gsfluent.materials import Material
from gsfluent.pipeline.run_context import RunContext
from gsfluent.pipeline.run_frames import SavedFrame, count_frames, save_frame
from gsfluent.pipeline.run_store import content_digest, fingerprint
from gsfluent.pipeline.simulate import Simulate, SimulationFrame
from gsfluent.scene import Scene

_STATE = "state.pt"
# Splats of this many standard deviations per particle spacing close a packing of particles.
_SIGMA_IN_SPACINGS = 0.6


def build_scene(shot: Shot, solids: dict[str, Solid], frame: Frame) -> Scene:
    """The scene of a shot: its solids with their materials, the floor, and the events.

    Args:
        shot: The shot.
        solids: Solid of each object by name.
        frame: World to scene.

    Raises:
        InputError: A material, part or event that cannot be.
    """
    scene = Scene(
        floor=None if shot.floor == "none" else 0.0,
        floor_mode=shot.floor_mode,
        floor_friction=shot.floor_friction,
    )
    for name, settings in shot.objects.items():
        parts = None if settings.parts is None else [part.to_dict() for part in settings.parts]
        scene.add(solids[name], _material(settings), frame=frame, parts=parts, name=name)
    for collider in shot.colliders:
        keys = collider_dict(collider)
        scene.add_collider(keys.pop("type"), **keys)
    for event in shot.events:
        scene.add_event(event_dict(event))
    return scene


def bullet_splats(particles: Particles, scene: Scene) -> Gaussians | None:
    """Steel-grey splats for bodies that have matter but no photographs, or None without any."""
    bare = [number for number, body in enumerate(scene.bodies) if body.solid is None]
    if not bare:
        return None
    rows = torch.isin(particles.body, torch.tensor(bare, device=particles.device).to(torch.int32))
    position, volume = particles.position[rows], particles.volume[rows]
    scales = _SIGMA_IN_SPACINGS * volume.pow(1.0 / 3.0)
    grey = torch.full_like(position, 0.25)
    return Gaussians.from_colors(position, scales, grey, opacities=0.95, label=SURFACE)


def _collider_key(collider: ColliderSettings) -> dict[str, Any]:
    """What a collider depends on: its settings, and the content of its mesh instead of its path."""
    keys = collider_dict(collider)
    if "mesh" in keys:
        keys["mesh"] = content_digest(Path(keys["mesh"]))
    return keys


def _material(settings: ObjectSettings) -> Material:
    return materials.get(settings.material).override(**dict(settings.overrides))


def load_solids(context: RunContext) -> dict[str, Solid]:
    """The textured solids of the run's objects, by name."""
    folder = context.store.root / "texture"
    return {name: Solid.load(folder / f"{name}.ply") for name in context.shot.objects}


def simulate_stage(context: RunContext) -> None:
    """Move the matter: ``stages/simulate/frame_0001.npz`` and so on."""
    shot = context.shot
    objects = {
        # the numbers of a preset, not its name: a retuned preset is another simulation
        name: [settings.to_dict(), repr(_material(settings))]
        for name, settings in shot.objects.items()
    }
    settings = [
        objects,
        [event_dict(event) for event in shot.events],
        [_collider_key(collider) for collider in shot.colliders],
        [shot.floor, shot.floor_mode, shot.floor_friction],
        shot.solve.quality,
        shot.output.fps,
        shot.output.seconds,
    ]
    key = fingerprint("simulate", context.key(context.source_key, settings))

    def work(folder: Path) -> dict[str, Any]:
        scene = build_scene(shot, load_solids(context), context.frame)
        stage = Simulate(quality=shot.solve.quality, seed=context.seed, device=context.device)
        state = folder / _STATE
        resume = state if state.is_file() and count_frames(folder) > 0 else None
        frames = stage(
            scene,
            fps=shot.output.fps,
            seconds=shot.output.seconds,
            progress=context.reporter.task("simulate"),
            resume=resume,
        )
        for frame in frames:
            save_frame(folder, saved(frame, scene))
            # after the frame: a state on disk always has its picture
            stage.save_state(state)
        return stage.report()

    result = context.store.run("simulate", key, work)
    report = dict(result.report)
    fill = context.record.values["fill"]
    # the number of material points is known only once the grid is
    for name in ("particles", "particles_per_cell"):
        if name in report and name not in fill:
            fill[name] = report[name]
    context.record.values["simulation"] = report
    context.source_key = result.fingerprint


def saved(frame: SimulationFrame, scene: Scene) -> SavedFrame:
    """What of a simulated frame goes to disk: splats of the solids, of bullets, transitions."""
    gaussians, groups = frame.gaussians, frame.groups
    if groups is None:
        groups = torch.full((gaussians.count,), -1, dtype=torch.int32, device=gaussians.device)
    carried = frame.carried.count
    bullets = bullet_splats(frame.particles, scene)
    if bullets is not None:
        first = torch.arange(gaussians.count, device=gaussians.device) < carried
        parts = [gaussians.select(first), bullets, gaussians.select(~first)]
        alone = torch.full((bullets.count,), -1, dtype=torch.int32, device=groups.device)
        gaussians = Gaussians.cat(parts)
        groups = torch.cat([groups[:carried], alone, groups[carried:]])
        carried += bullets.count
    return SavedFrame(
        index=frame.index,
        time=frame.time,
        gaussians=gaussians,
        groups=groups,
        carried=carried,
        positions=frame.particles.position,
        volumes=frame.particles.volume,
        damage=frame.damage,
        fragments=frame.fragments,
        facts=dict(frame.stats) | {"energy": dict(frame.energy)},
    )
