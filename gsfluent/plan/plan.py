"""What a shot will cost, before it is paid: ``gsfluent plan``.

Nothing is simulated. A proxy of the solid (the splat coarsely filled, the hull that masks carve,
or an ellipsoid in the box of sparse points) says how much matter there is; what happens to it is
foreseen in closed form (:mod:`gsfluent.plan.motion`); a cost model measured on this machine
(:mod:`gsfluent.plan.cost`) says what that takes.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.materials import BREAKS
from gsfluent.pipeline.matter.points import MAX_PARTICLES, POINTS_PER_CELL, grid_spacing
from gsfluent.pipeline.simulate.stage import QUALITY
from gsfluent.pipeline.solid.walls import WALL_CELLS
from gsfluent.plan.bounds import THIN_CELLS, bounds_of, budget_spacing, choose_cells, thickness
from gsfluent.plan.cost import Cost, CostModel, memory_of
from gsfluent.plan.fact import STAGES
from gsfluent.plan.motion import Outlook, foresee
from gsfluent.plan.proxy import Proxy, proxy
from gsfluent.plan.work import (
    NOT_PREDICTED,
    born_splats,
    export_work,
    fill_work,
    isolate_work,
    laws_of,
    passes_of,
    reconstruct_work,
    render_work,
    simulate_work,
    splat_count,
    texture_method,
    texture_work,
)
from gsfluent.progress import Progress
from gsfluent.scene.scene import Scene
from gsfluent.stages.breaking import breaking_rows
from gsfluent.stages.findings import cells_for, cells_for_walls, lowered, setting, walls_note
from gsfluent.stages.simulate import build_scene, solver_options


def cost_model(
    device: torch.device | str,
    *,
    recalibrate: bool = False,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> CostModel:
    """The cost model of a device: the stored one, or a new one from the probe, which is stored.

    One that runs have made is not enough here.

    Raises:
        RunError: The disk is full.
    """
    found = None if recalibrate else CostModel.load(device, folder)
    if found is not None and found.measured:
        return found
    from gsfluent.plan.probe import calibrate

    model = calibrate(device, progress)
    model.save(device, folder)
    return model


@dataclasses.dataclass(frozen=True)
class Prospect:
    """A shot with a proxy of its solids: everything that does not hang on the size of the cells."""

    shot: Shot  # The shot
    proxy: Proxy  # Proxies of its objects
    scene: Scene  # Its scene with them
    frames: int  # Frames
    warnings: tuple[str, ...]  # What was not known

    @classmethod
    def of(cls, shot: Shot) -> Prospect:
        """Look at the input of a shot.

        Raises:
            InputError: The input cannot be read, or a material or event cannot be.
        """
        warnings: list[str] = []
        found = proxy(shot, warnings)
        scene = build_scene(shot, dict(found.solids), found.frame)
        frames = max(1, round(shot.output.fps * shot.output.seconds))
        return cls(shot, found, scene, frames, tuple(warnings))

    def counts(self, dx: float) -> list[int]:
        """Material points of each body."""
        return [max(1, round(b.volume * POINTS_PER_CELL / dx**3)) for b in self.scene.bodies]

    @functools.cached_property
    def wall_cells(self) -> tuple[int, int]:
        """Cells along the largest body that walls get, and that they want."""
        return cells_for_walls(
            self.scene, self.shot.solve.quality, self.shot.solve.points_for_walls
        )

    def outlook(self, dx: float) -> Outlook:
        """What happens on a grid of spacing ``dx``."""
        # the run simulates until its last frame, not until the end
        seconds = (self.frames - 1) / self.shot.output.fps
        cfl = self.shot.solve.cfl
        return foresee(self.scene, dx, seconds, self.frames, self.counts(dx), cfl=cfl)

    def splats(self, cells: int) -> tuple[float, dict[str, float]]:
        """Splats of the solids, and the features of filling them."""
        fill, inside = fill_work(self.shot, self.proxy, splat_count(self.shot, self.proxy), cells)
        return fill["splats"] + sum(inside.values()), fill

    def simulation(self, dx: float, cells: int) -> tuple[Outlook, dict[str, float]]:
        """What happens, and the features of simulating it."""
        outlook = self.outlook(dx)
        cracks = self.shot.output.cracks != "none"
        return outlook, simulate_work(
            outlook, self.scene, self.frames, self.splats(cells)[0], cracks,
            points=float(sum(self.counts(dx))),
        )  # fmt: skip

    def frame_seconds(self, model: CostModel, cells: int) -> float:
        """Seconds that simulating a frame takes with so many cells."""
        dx = grid_spacing(self.scene, cells)
        # the voxels of the solid, and so the splats, follow quality, not cells
        work = self.simulation(dx, QUALITY[self.shot.solve.quality])[1]
        return model.stage("simulate", work).seconds / self.frames


def plan_shot(
    shot: Shot, *, device: torch.device | str = "cpu", seed: int = 0, model: CostModel | None = None
) -> dict[str, Any]:
    """Plan a shot.

    Returns:
        ``passes`` (name, needed, why), ``bounds``, ``binding`` and ``budget``, ``dx``, ``contact``
        (``points`` or ``nodes``), ``cells``,
        ``breaking`` (:func:`gsfluent.stages.breaking.breaking_rows`), ``dt``, ``substeps``,
        ``particles``, ``active_blocks``, ``stages`` (seconds and
        memory_bytes by name), ``seconds``, ``memory_bytes``, ``simulate_seconds``, ``frames``,
        ``size_m``, ``assumed``, ``warnings``, ``calibrated``, ``model`` (when it was measured,
        corrections by runs), ``device`` and ``work`` (features by stage); ``refused``, why a run
        refuses the shot, and ``hint``, what to do, both empty where it does not.

    Raises:
        InputError: The input cannot be read, or a material or event cannot be.
    """
    prospect = Prospect.of(shot)
    chosen = cells_of(prospect, model)
    dx = grid_spacing(prospect.scene, chosen)
    quality = QUALITY[shot.solve.quality]
    outlook, simulated = prospect.simulation(dx, quality)
    work = _work(prospect, quality, simulated)
    kind = torch.device(device).type
    stages = {name: _costs(model, name, work[name], shot, kind) for name in STAGES if name in work}
    seconds = [row["seconds"] for row in stages.values()]
    total = sum(seconds) if all(value is not None for value in seconds) else None
    counts = prospect.counts(dx)
    least = None if shot.solve.seconds_per_frame is None or model is None else dx
    bounds, binding = bounds_of(
        prospect.scene.bodies, dx, strike=outlook.strike_speed, budget=least
    )
    breaking = _breaking(prospect, outlook, dx)
    warnings = [*prospect.warnings, *_warnings(prospect, outlook, dx, sum(counts))]
    warnings += _unbroken(breaking)
    if texture_method(shot) in NOT_PREDICTED:
        warnings.append(
            f"texture: what {texture_method(shot)} costs hangs on the model you bring and is not "
            "predicted; hint: texture.method: exemplar is"
        )
    # what one run has taught is no reason to refuse another
    sure = stages["simulate"]["seconds"] if model is not None and model.measured else None
    refused, hint = _too_long(prospect, outlook, dx, sure, sum(counts))
    if refused:
        warnings.append(f"gsfluent run refuses this shot: {refused}; hint: {hint}")
    first = next(body for body in prospect.scene.bodies if body.solid is not None)
    low, high = first.bounds()
    return {
        "device": str(device),
        "calibrated": model is not None,
        "model": None if model is None else _about(model),
        "passes": passes_of(shot, prospect.scene, outlook),
        "size_m": (high - low).tolist(),
        "assumed": prospect.proxy.assumed,
        "frames": prospect.frames,
        "cells": chosen,
        "dx": dx,
        "contact": solver_options(shot).decided(prospect.scene).contact,
        "bounds": [bound.row() for bound in bounds],
        "binding": binding,
        "budget": _budget(prospect, model),
        "dt": outlook.dt,
        "substeps": outlook.substeps,
        "grid_from": outlook.grid_from,
        "impact_speed": outlook.strike_speed,
        "wave_speed": outlook.wave,
        "breaking": breaking,
        "particles": sum(counts),
        "particles_per_cell": POINTS_PER_CELL,
        "active_blocks": outlook.blocks,
        "stages": stages,
        "seconds": total,
        "simulate_seconds": stages["simulate"]["seconds"],
        "memory_bytes": max(row["memory_bytes"] for row in stages.values()),
        "work": work,
        "warnings": warnings,
        "refused": refused,
        "hint": hint,
    }


_STEP, _POINT_STEP = 2e-5, 2e-10
"""Seconds that no machine goes below, for a step and for each of its points."""


def _too_long(
    prospect: Prospect, outlook: Outlook, dx: float, seconds: float | None, points: int
) -> tuple[str, str]:
    """Why a shot takes longer than it may, and what to do; empty where it does not."""
    said = "about"
    if seconds is None:
        seconds, said = outlook.substeps * (_STEP + _POINT_STEP * points), "at least"
    hours, allowed = seconds / 3600.0, prospect.shot.solve.max_hours
    if hours <= allowed:
        return "", ""
    low, high = prospect.scene.bodies[0].bounds()
    longest = float((high - low).max())
    return (
        f"the simulation takes {said} {hours:.3g} hours, more than solve.max_hours: {allowed:g}; "
        f"an object {longest:.3g} m long on cells of {dx:.3g} m needs {outlook.substeps} steps of "
        f"{outlook.dt:.2g} s"
    ), (
        "check size and scale, take fewer solve.cells or a shorter output.seconds; or allow it: "
        f"solve.max_hours: {math.ceil(hours)}"
    )


def cells_of(prospect: Prospect, model: CostModel | None) -> int:
    """Cells along the largest body: the shot's, or as many as its time budget allows.

    Raises:
        InputError: The budget is too small for any grid.
    """
    solve = prospect.shot.solve
    if solve.seconds_per_frame is None or model is None:
        if solve.cells is not None:
            return solve.cells
        return prospect.wall_cells[0]
    return choose_cells(lambda cells: prospect.frame_seconds(model, cells), solve.seconds_per_frame)


def _budget(prospect: Prospect, model: CostModel | None) -> dict[str, float] | None:
    """The time budget of a shot, and what the formula that counts points alone makes of it."""
    seconds = prospect.shot.solve.seconds_per_frame
    if seconds is None or model is None:
        return None
    return {"seconds_per_frame": seconds, "dx_by_formula": rough_spacing(prospect, model, seconds)}


def rough_spacing(prospect: Prospect, model: CostModel, budget: float) -> float:
    """The textbook's answer: only points cost something (:func:`budget_spacing`) [m]."""
    outlook = prospect.outlook(grid_spacing(prospect.scene, QUALITY["preview"]))
    per_point = max(v for n, v in model.seconds["simulate"].items() if n.startswith("point_steps"))
    return budget_spacing(
        sum(body.volume for body in prospect.scene.bodies),
        wave=outlook.wave + outlook.speed,
        frame=1.0 / prospect.shot.output.fps,
        seconds=budget,
        per_point_step=per_point,
    )


def _about(model: CostModel) -> dict[str, Any]:
    """When a model was measured, and what runs have taught it."""
    return {
        "measured": model.made or ("at a glance" if model.probe_seconds else "by finished runs"),
        "corrections": {name: model.correction(name) for name in model.ratios},
        "runs": max((len(ratios) for ratios in model.ratios.values()), default=0),
        "fit_errors": dict(model.errors),
    }


def _work(
    prospect: Prospect, quality: int, simulated: dict[str, float]
) -> dict[str, dict[str, float]]:
    """Features of every stage that the shot has."""
    shot, proxy, frames = prospect.shot, prospect.proxy, prospect.frames
    splats, fill = prospect.splats(quality)
    work = {}
    if proxy.photographs is not None:
        work["reconstruct"] = reconstruct_work(proxy.photographs, shot)
    work["isolate"] = isolate_work(fill["splats"])
    work["fill"] = fill
    work["texture"] = texture_work(texture_method(shot), fill)
    work["simulate"] = simulated
    drawn = splats + born_splats(simulated)
    work["render"] = render_work(shot, frames, drawn)
    if any(kind != "mp4" for kind in shot.output.what):
        work["export"] = export_work(shot, frames, drawn)
    return work


def _costs(
    model: CostModel | None, name: str, features: dict[str, float], shot: Shot, kind: str
) -> dict[str, Any]:
    """Seconds and bytes of a stage; seconds are None where nobody can know them."""
    if model is None or name not in model.seconds:
        return {"seconds": None, "memory_bytes": memory_of(name, features, kind)}
    cost: Cost = model.stage(name, features)
    unknown = name == "texture" and texture_method(shot) in NOT_PREDICTED
    return {"seconds": None if unknown else round(cost.seconds, 3), "memory_bytes": cost.bytes}


def _breaking(prospect: Prospect, outlook: Outlook, dx: float) -> list[dict[str, Any]]:
    """:func:`gsfluent.stages.breaking.breaking_rows` of all objects that are not led."""
    pull = math.hypot(*prospect.scene.gravity)
    movers = {mover.body: mover for mover in outlook.movers if mover.body is not None}
    rows = []
    for number, body in enumerate(prospect.scene.bodies):
        mover = movers[number]
        if body.solid is None or mover.driven:
            continue
        rows += breaking_rows(body, mover.speed or None, pull, dx)
    return rows


def _unbroken(rows: list[dict[str, Any]]) -> list[str]:
    """What meets something brittle enough to break, and too slowly for any part of it."""
    found = []
    for name in dict.fromkeys(row["object"] for row in rows):
        brittle = [row for row in rows if row["object"] == name and row["breaks_from"] is not None]
        if not brittle or any(row["breaks"] for row in brittle):
            continue
        weakest = min(brittle, key=lambda row: float(row["breaks_from"]))
        if weakest["lands_with"] is not None:
            found.append(
                f"{name}: meets something at {weakest['lands_with']:.2g} m/s, but "
                f"{weakest['material']} breaks from about {weakest['breaks_from']:.2g} m/s; hint: "
                f"{weakest['hint']}"
            )
    return found


def insulated(shot: Shot) -> list[str]:
    """Heat that somebody may wait for in vain: it passes between what has a temperature."""
    warm = {
        name: settings.temperature
        for name, settings in shot.objects.items()
        if settings.temperature is not None
    }
    if not warm or (len(warm) == len(shot.objects) and not shot.colliders):
        return []
    said = ", ".join(f"{name} ({degrees:g} C)" for name, degrees in warm.items())
    return [
        f"no heat passes to colliders, or to objects without a temperature: {said}; hint: give "
        "objects one; heat.air, heat.transfer and heat.floor give and take it"
    ]


def _warnings(prospect: Prospect, outlook: Outlook, dx: float, particles: int) -> list[str]:
    """What a user should mend before an hour is spent."""
    shot, scene = prospect.shot, prospect.scene
    found = []
    if shot.solve.error is not None:
        found.append(
            "solve.error chooses the cells by probes when the shot is run, this plan has those of "
            f"quality: {shot.solve.quality}; hint: gsfluent chart SHOT.yaml --error "
            f"{shot.solve.error:.3g} chooses now"
        )
    warm = any(settings.temperature is not None for settings in shot.objects.values())
    if not shot.events and not shot.colliders and not warm:
        found.append(
            "the shot has no events: the object will only rest on the floor; hint: add an event"
        )
    found += insulated(shot)
    if particles > MAX_PARTICLES:
        found.append(
            f"{particles} material points, more than the {MAX_PARTICLES} that a run takes; hint: "
            "fewer solve.cells"
        )
    for body in scene.bodies:
        if body.solid is None:
            continue
        thin = thickness(body)
        if thin < THIN_CELLS * dx:
            wall = cells_for(scene, thin / WALL_CELLS)
            breaks = f"{setting(wall)} lets it break as a wall ({WALL_CELLS:g} cells), "
            found.append(
                f"{body.name}: {1000 * thin:.3g} mm at its thinnest, {thin / dx:.2g} cells of "
                f"{1000 * dx:.3g} mm, under {THIN_CELLS:g}; hint: "
                f"{breaks if thin < WALL_CELLS * dx else ''}"
                f"{setting(cells_for(scene, thin / THIN_CELLS))} lets it bend"
            )
    solve = shot.solve
    if solve.cells is None and solve.seconds_per_frame is None and solve.error is None:
        if note := walls_note(solve.quality, *prospect.wall_cells, solve.points_for_walls):
            found.append(note)
    found.extend(lowered(scene, dx))
    if outlook.grid_seconds <= 0.0:
        found.append(
            "nothing meets anything before the end; hint: a longer output.seconds, or another event"
        )
    if not laws_of(scene) & set(BREAKS) and any(
        e.__class__.__name__ == "Bullet" for e in shot.events
    ):
        found.append("nothing is brittle, so the bullet breaks nothing; hint: another material")
    return found
