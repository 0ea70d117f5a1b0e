"""What a live session begins with: the prepared objects of a run, of a shot, or one solid."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from gsfluent import materials
from gsfluent.config import Shot, load_shot
from gsfluent.errors import InputError
from gsfluent.io.solid import load_solid, volume_path
from gsfluent.pipeline.matter.points import POINTS_PER_CELL
from gsfluent.progress import Reporter
from gsfluent.results.digests import require_intact
from gsfluent.results.lock import locked
from gsfluent.results.record import read_frame, shot_of
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import build_scene
from gsfluent.stages.solids import context_of, load_solids, make_solids

HELP = "give a run folder (OUT), a shot (SHOT.yaml) or a filled solid (.ply) with a material"


@dataclasses.dataclass(frozen=True)
class Stage:
    """A scene at rest and where it came from.

    Attributes:
        title: Short name.
        scene: Objects, floor, colliders; nothing happens in it.
        shot: The shot it belongs to: light, floor, camera; its events are those of nobody yet.
    """

    title: str
    scene: Scene
    shot: Shot


def open_stage(
    source: Path,
    *,
    material: str | None = None,
    out: Path | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    reporter: Reporter | None = None,
) -> Stage:
    """Set up what is to be poked.

    Args:
        source: Folder of a run whose objects are filled and textured, a shot, or a filled solid.
        material: Preset for a solid; refused for a run or a shot, which say it themselves.
        out: Folder in which the stages of a shot are done, or found done.
        device: Where these compute.
        seed: Seed of everything random.
        reporter: Receives progress; log lines by default.

    Raises:
        InputError: Nothing of the kind is there, or an argument does not belong to it.
    """
    if not source.exists():
        raise InputError(f"live: there is no {source}", hint=HELP)
    solid = source.suffix.lower() == ".ply"
    if material is not None and not solid:
        raise InputError(
            f"live: {source} says itself what its objects are made of",
            hint="leave out the material, or change objects.*.material in the shot",
        )
    if solid:
        return _of_solid(source, material)
    if source.is_dir():
        shot, out = shot_of(source), source
        context = context_of(shot, out, device, seed, reporter)
        if not all((out / "stages" / "texture" / f"{name}.ply").is_file() for name in shot.objects):
            raise InputError(
                f"live: the objects of {out} are not filled and textured yet",
                hint="finish `gsfluent run` first, or give its shot",
            )
        for name in ("isolate", "texture"):
            require_intact(out / "stages" / name)
        context.frame = read_frame(out / "stages" / "isolate")
    else:
        shot = load_shot(source)
        if out is None:
            raise InputError(
                f"live: the objects of {source} are prepared in a run folder",
                hint="name it (-o OUT); `gsfluent run` goes on from there",
            )
        context = context_of(shot, out, device, seed, reporter)
        with locked(out):
            make_solids(context)
    shot = dataclasses.replace(shot, events=())
    scene = build_scene(shot, load_solids(context), context.frame)
    return Stage(out.resolve().name, _stood(scene), shot)


def _of_solid(path: Path, material: str | None) -> Stage:
    if not volume_path(path).is_file():
        raise InputError(
            f"live: {path} is no filled solid (no {volume_path(path).name} beside it)",
            hint="fill it first: gsfluent fill",
        )
    solid = load_solid(path)
    name = path.stem
    preset = "fruit.watermelon" if material is None else material
    scene = Scene()
    scene.add(solid, materials.get(preset), name=name)
    shot = Shot.from_dict(
        {"splats": str(path.resolve()), "objects": {name: {"material": preset}}}, path.parent
    )
    return Stage(name, _stood(scene), shot)


def _stood(scene: Scene) -> Scene:
    """Put the objects, as they stand to each other, onto the floor."""
    if scene.floor is not None:
        lowest = min(float(body.bounds()[0][2]) for body in scene.bodies)
        scene.lift(scene.floor - lowest)
    return scene


BUDGET = {"cpu": 6_000, "cuda": 30_000}
"""Material points of quality ``live`` by device (docs/measured/live.md)."""


CELLS = (8, 64)
"""Fewest and most cells along the longest side of the largest solid."""


def live_cells(scene: Scene, device: torch.device) -> int:
    """Cells along the longest side that keep the scene within :data:`BUDGET` on a device.

    The same device type gives the same cells on every machine, so that what was poked can be
    repeated.
    """
    longest = max(
        float((high - low).max())
        for low, high in (body.bounds() for body in scene.bodies if body.solid is not None)
    )
    volume = sum(body.volume for body in scene.bodies)
    budget = BUDGET.get(device.type, BUDGET["cpu"])
    dx = (volume * POINTS_PER_CELL / budget) ** (1.0 / 3.0)
    return min(max(int(longest / dx), CELLS[0]), CELLS[1])
