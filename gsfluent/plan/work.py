"""How much work each stage of a run has: the features of the cost model.

The same functions serve what is planned and what a run has done (:mod:`gsfluent.plan.fact`
fills in what it really had), so that the two can be told apart: work that was foreseen wrongly, and
work that costs something else than the model says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.data import Solid
from gsfluent.materials import BREAKS
from gsfluent.pipeline.fill.stage import fill_resolution
from gsfluent.pipeline.light.from_shot import light_of
from gsfluent.pipeline.reconstruct.recipe import recipe_for
from gsfluent.plan.cost import framing, law_set, stepping
from gsfluent.plan.motion import Outlook
from gsfluent.plan.proxy import Photographs, Proxy
from gsfluent.scene.scene import Scene

NOT_PREDICTED = ("diffusion", "inpaint")
"""Texture methods whose cost is that of a model which the user brings."""
_ITERATIONS = 800
_FULL = 0.9
"""How full the budget of splats is in the end (0.63 to 1.0 in the gallery)."""
_SCENE_SHARE = 0.6
"""Share of the steps that learn everything, where there are no masks."""
_SCENE_GROWTH = 0.6
"""Splats of a training without masks, in which the object starts anew, over those of one with
(apple 0.52, skull 0.68)."""
_SPACING = 1.25
"""Distance of interior splats [voxels]."""
_PRUNED = 0.12
"""Share of them that the photographs contradict: 0.09 to 0.39, median 0.12 (measured)."""
_MOST_INTERIOR = 200_000
_BORN = 1.3
"""Splats born at cracks by the end of a shot that breaks, of each material point: 0.25 to 3.3 in 15
shots of the gallery of 13 k to 1.5 M points. Of each splat they were 0.03 to 6.5."""
_PADDING = 6
"""Empty voxels around a solid, both sides together."""

Features = dict[str, float]


def reconstruct_work(photographs: Photographs, shot: Shot, splats: float | None = None) -> Features:
    """Training: photographs read, steps, pixels and splats of all steps.

    Args:
        photographs: What is looked at.
        shot: For the settings.
        splats: Splats in a step, mean; guessed from the settings when absent.
    """
    wanted = shot.reconstruct
    steps = wanted.iterations or _ITERATIONS
    recipe = recipe_for(wanted.recipe or "auto", steps)
    most = wanted.max_gaussians or recipe.max_gaussians
    grown = splat_growth(most, recipe.start_gaussians)
    if not photographs.masked:
        grown *= _SCENE_GROWTH
    mean = grown if splats is None else splats
    small = recipe.half_until * 0.25 + (1.0 - recipe.half_until)
    pixels = photographs.object_pixels
    if not photographs.masked:
        pixels = _SCENE_SHARE * photographs.pixels + (1.0 - _SCENE_SHARE) * pixels
    return {
        "start": 1.0,
        "images": float(photographs.images),
        "source_pixels": photographs.source_pixels,
        "steps": float(steps),
        "step_pixels": steps * pixels * small,
        "step_splats": steps * mean,
        "splats_most": float(most),
    }


def splat_growth(most: float, start: float) -> float:
    """Mean number of splats over a training that starts with ``start`` and may have ``most``.

    Measured on the gallery (docs/theory/plan.md): the count rises for the first half and stays.
    """
    begin = min(start, most)
    return 0.25 * 0.5 * (begin + most) + 0.75 * most * _FULL


def splat_count(shot: Shot, proxy: Proxy) -> float:
    """Splats of the object after the reconstruction."""
    if proxy.splats is not None:
        return float(proxy.splats)
    wanted = shot.reconstruct
    recipe = recipe_for(wanted.recipe or "auto", wanted.iterations or _ITERATIONS)
    return _FULL * (wanted.max_gaussians or recipe.max_gaussians)


def isolate_work(splats: float) -> Features:
    """Telling the object from its background."""
    return {"start": 1.0, "splats": splats}


def fill_work(
    shot: Shot, proxy: Proxy, splats: float, cells: int
) -> tuple[Features, dict[str, float]]:
    """Filling: voxels, and splats put inside.

    Returns:
        The features, and splats of the inside by object.
    """
    solids = proxy.solids
    extents = {name: _extent(solid) for name, solid in solids.items()}
    largest = max(extents.values())
    given = shot.fill.given(proxy.frame.scale).get("resolution")
    voxels = matter = most = 0.0
    inside, placed = {}, []
    for name, solid in solids.items():
        wanted = given or fill_resolution(extents[name], largest, cells)
        voxel = extents[name] / wanted
        sides = _sides(solid)
        box = math.prod(side / voxel + _PADDING for side in sides)
        voxels, most = voxels + box, max(most, box)
        own = solid.volume / voxel**3
        matter += own
        placed.append(min(_MOST_INTERIOR, own / _SPACING**3))
        inside[name] = (1.0 - _PRUNED) * placed[-1]
    photographs = proxy.photographs
    return {
        "start": 1.0,
        "objects": float(len(solids)),
        "voxels": voxels,
        "matter_voxels": matter,
        "inner": sum(placed),
        "voxels_most": most,
        "inner_most": max(placed),
        "images": 0.0 if photographs is None else float(photographs.images * len(solids)),
        "splats": splats,
    }, inside


def texture_method(shot: Shot) -> str:
    """The method that the texture stage will take."""
    return shot.texture.chosen


def texture_work(method: str, fill: Mapping[str, float]) -> Features:
    """Colouring: voxels by method."""
    kind = "exemplar" if method == "exemplar" else "procedural"
    return {
        "start": 1.0,
        f"{kind}_objects": fill["objects"],
        f"{kind}_voxels": fill["voxels"],
        "volume_most": fill["voxels_most"],
        "splats": fill["splats"] + fill["inner"],
    }


def simulate_work(
    outlook: Outlook, scene: Scene, frames: int, gaussians: float, cracks: bool, *, points: float
) -> Features:
    """Simulating: steps, and what each frame costs beside them.

    Args:
        outlook: What is to come.
        scene: For the laws.
        frames: Frames.
        gaussians: Splats that are carried.
        cracks: Whether they are repaired along cracks.
        points: All material points.
    """
    laws = laws_of(scene)
    brittle = bool(laws & set(BREAKS))
    breaks = cracks and brittle and outlook.shatters
    seconds = max(outlook.grid_from + outlook.grid_seconds, 1e-12)
    broken = max(0.0, 1.0 - outlook.struck / seconds) if math.isfinite(outlook.struck) else 0.0
    fields = len(scene.bodies) + (1 if brittle and outlook.shatters else 0)
    return (
        {"start": 1.0}
        | stepping(
            outlook.points, outlook.blocks, outlook.substeps,
            fields=fields, laws=law_set(laws),
        )
        | framing(frames, gaussians, points, brittle=breaks, broken=broken)
        | {"blocks_most": outlook.blocks_most, "points": points, "gaussians": gaussians,
           "born": _BORN * points * (1.0 if breaks and broken > 0 else 0.0)}
    )  # fmt: skip


def born_splats(simulated: Mapping[str, float]) -> float:
    """Splats born at cracks, mean over the frames: they come with the cracks and stay."""
    return simulated["born"] * simulated["broken_frames"] / max(simulated["frames"], 1.0)


def render_work(shot: Shot, frames: int, gaussians: float) -> Features:
    """Rendering: pixels and splats of all frames."""
    width, height = shot.output.size
    return {
        "start": 1.0,
        "frames": float(frames),
        "frame_pixels": float(frames * width * height),
        "frame_gaussians": frames * gaussians,
        "gaussians": gaussians,
        "pixels": float(width * height),
    }


def export_work(shot: Shot, frames: int, gaussians: float) -> Features:
    """Exporting: splats of all frames, by kind of file."""
    kinds = [kind for kind in shot.output.what if kind != "mp4"]
    costs = {f"{kind}_gaussians": frames * gaussians for kind in kinds}
    return {"start": 1.0, "gaussians": gaussians} | costs


def mean_splats(history: list[list[Any]], iterations: int) -> float | None:
    """Splats in a step, mean, from the history of a reconstruction's report; None without one."""
    if not history:
        return None
    total, at = 0.0, 0.0
    for step, count, _ in history:
        total += (step - at) * count
        at = step
    return (total + max(0.0, iterations - at) * history[-1][1]) / max(iterations, at)


def _sides(solid: Solid) -> list[float]:
    index = solid.occupancy.nonzero()
    span = (index.amax(dim=0) - index.amin(dim=0) + 1).to(torch.float64) * solid.voxel
    return [float(side) for side in span]


def _extent(solid: Solid) -> float:
    return max(_sides(solid))


def laws_of(scene: Scene) -> set[str]:
    """Laws of all materials of a scene."""
    return {
        material.law
        for body in scene.bodies
        for material in [body.material, *(part.material(body.material) for part in body.parts)]
    }


def passes_of(shot: Shot, scene: Scene, outlook: Outlook) -> list[dict[str, Any]]:
    """The passes: ``pass``, ``needed`` and ``why``."""
    laws = laws_of(scene)
    breaks = bool(laws & set(BREAKS))
    brittle = f"brittle matter ({', '.join(sorted(laws & set(BREAKS)))})"
    several = len(scene.bodies) > 1
    flies = outlook.grid_from > 0.0
    gridded = outlook.grid_seconds > 0.0
    exports = [kind for kind in shot.output.what if kind != "mp4"]
    things = _names(scene.colliders)
    rests = scene.floor is not None and any(scene.gravity)
    fields = (
        f"{len(scene.bodies)} bodies" if several else "one body that can break: pieces get fields"
    )
    method = texture_method(shot)
    lamps = light_of(shot).lamps
    casting = [lamp for lamp in lamps if lamp.shadow]
    rows = [
        ("reconstruct", shot.capture is not None, "photographs", "splats are given"),
        ("fill", True, "splats are a shell", ""),
        ("texture", True, f"the inside has no colours yet ({method})", ""),
        ("grid", gridded, f"from t = {outlook.grid_from:.3g} s on",
         "nothing touches anything: free flight in closed form"),
        ("free flight", flies, f"closed form until t = {outlook.grid_from:.3g} s",
         "something touches something from the start"),
        ("contact fields", gridded and (several or (breaks and outlook.shatters)), fields,
         "one body that stays in one piece: one velocity field"),
        ("damage variable", gridded and breaks, brittle, "no brittle matter"),
        ("return map", gridded and bool(laws - {"elastic"}),
         f"matter that yields ({', '.join(sorted(laws - {'elastic'}))})", "no matter yields"),
        ("rigid things", bool(scene.colliders), things, "only the floor" if rests else "none"),
        ("blades", bool(scene.blades), _names(scene.blades), "nothing is cut"),
        ("sleep", rests, "what comes to rest leaves the grid", "nothing to rest on"),
        ("repair", breaks and shot.output.cracks != "none", f"cracks open ({shot.output.cracks})",
         "cracks are not drawn" if breaks else "nothing can crack"),
        ("light", True, _counted(len(lamps), "lamp"), ""),
        ("shadows", bool(casting), f"of {_counted(len(casting), 'lamp')}", "no lamp casts any"),
        ("export", bool(exports), ", ".join(exports), "only the video is asked for"),
    ]  # fmt: skip
    return [{"pass": n, "needed": need, "why": yes if need else no} for n, need, yes, no in rows]


def _names(things: Sequence[Any]) -> str:
    return ", ".join(thing.name for thing in things)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
