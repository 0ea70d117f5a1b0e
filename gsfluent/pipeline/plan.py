"""What a shot will cost, before it is paid: ``gsfluent plan``.

Nothing is simulated. A stand-in solid (the splat coarsely filled, or an ellipsoid in the box of a
capture's sparse points) is given its material points exactly as the run will do it; dx, dt and the
number of blocks follow from them, and one transfer on these points is timed on this machine.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from gsfluent import ops
from gsfluent.config import Drop, Shot
from gsfluent.data import SURFACE, Frame, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.io import load, load_capture
from gsfluent.pipeline.fill import Fill
from gsfluent.pipeline.inspect import inspect
from gsfluent.pipeline.orient import DEFAULT_SIZE, make_frame
from gsfluent.pipeline.particles import POINTS_PER_CELL, Matter
from gsfluent.pipeline.run_simulate import build_scene
from gsfluent.pipeline.simulate import Simulate
from gsfluent.pipeline.simulate_solver import CFL
from gsfluent.scene import Blade, Body, Collider, Scene

_STAND_IN_VOXELS = 48
# State before and after a step, sorted copies, stress and splat binding, in units of one state.
_STATE_COPIES = 5
_NODE_VALUES = 4 + 3 + 6
_GRAVITY = 9.81


def plan_shot(shot: Shot, *, device: torch.device, seed: int = 0) -> dict[str, Any]:
    """Plan a shot.

    Args:
        shot: The shot.
        device: Where it would run.
        seed: Seed of the point positions.

    Returns:
        ``passes`` (name, needed, why), ``dx``, ``dt``, ``substeps``, ``particles``,
        ``active_blocks``, ``memory_bytes``, ``simulate_seconds``, ``frames``, ``size_m``,
        ``assumed`` and ``warnings``.

    Raises:
        InputError: The input cannot be read, or a material or event cannot be.
    """
    warnings: list[str] = []
    solid, frame, assumed = _stand_in(shot, warnings)
    scene = build_scene(shot, dict.fromkeys(shot.objects, solid), frame)
    stage = Simulate(quality=shot.solve.quality, seed=seed, device=device)
    matter = stage.prepare(scene)
    solids = [body for body in scene.bodies if body.solid is not None]
    speeds = [_impact_speed(body, scene) for body in scene.bodies]
    speeds += [math.hypot(*thing.velocity) for thing in scene.colliders]
    speed = max([*speeds, *(blade.speed for blade in scene.blades)])
    wave = max(_fastest(body) for body in scene.bodies)
    dt = CFL * matter.dx / (wave + speed)
    moved = len(scene.bodies) + len(scene.colliders) + len(scene.blades)
    grid_seconds = max(0.0, shot.output.seconds - _flight_seconds(shot, moved))
    substeps = math.ceil(grid_seconds / dt)
    blocks = ops.build_blocks(matter.rest, matter.dx)
    active = int(blocks.coords.shape[0])
    per_step = _time_step(matter, blocks, dt)
    _warn(warnings, solids, speed, matter, shot)
    low, high = solids[0].bounds()
    return {
        "passes": _passes(shot, scene),
        "size_m": (high - low).tolist(),
        "assumed": assumed,
        "frames": max(1, round(shot.output.fps * shot.output.seconds)),
        "dx": matter.dx,
        "dt": dt,
        "substeps": substeps,
        "impact_speed": speed,
        "wave_speed": wave,
        "particles": matter.particles.count,
        "particles_per_cell": POINTS_PER_CELL,
        "active_blocks": active,
        "memory_bytes": _memory(matter, active),
        "simulate_seconds": round(substeps * per_step, 1),
        "device": str(device),
        "warnings": warnings,
    }


def _stand_in(shot: Shot, warnings: list[str]) -> tuple[Solid, Frame, str]:
    """A solid of about the right size and volume, its frame, and what was assumed."""
    if shot.splats is not None:
        gaussians = load(shot.splats).validated(shot.splats.name)
        frame = make_frame(gaussians, None, shot)
        options = shot.fill.given(frame.scale) | {"resolution": _STAND_IN_VOXELS}
        solid = Fill(**options, refine_views=0)(gaussians)
        return _grey(solid), frame, f"the splat, filled at {_STAND_IN_VOXELS} voxels"
    if shot.capture is None:
        raise InputError("the shot has neither capture nor splats", "name one input")
    load_capture(shot.capture)  # what is wrong with it is an error; what is not in it is a warning
    try:
        report = inspect(shot.capture, None, size=shot.size)
    except InputError as error:
        size = shot.size or DEFAULT_SIZE
        warnings.append(f"the object's size is not known ({error.what}): assumed {size:g} m")
        return _ellipsoid([size] * 3), Frame.identity(), f"a ball of {size:g} m"
    box = [float(x) for x in report["box"]["size"]]
    if shot.scale is not None:
        box = [x * shot.scale / float(report["scale"]["metres_per_unit"]) for x in box]
    return _ellipsoid(box), Frame.identity(), "an ellipsoid in the box of what is seen"


def _ellipsoid(size: list[float]) -> Solid:
    """An ellipsoid that stands on z = 0 and fills a box of ``size`` [m]."""
    extents = torch.tensor(size, dtype=torch.float32).clamp(min=1e-6)
    voxel = float(extents.amax()) / _STAND_IN_VOXELS
    counts = [max(2, math.ceil(float(e) / voxel)) for e in extents]
    axes = [(torch.arange(n) + 0.5) / n * 2.0 - 1.0 for n in counts]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    inside = x * x + y * y + z * z <= 1.0
    origin = torch.tensor([-0.5, -0.5, 0.0]) * extents
    radius = (x * x + y * y + z * z).sqrt()
    depth = (1.0 - radius).clamp(min=0.0) * 0.5 * float(extents.amin())
    middle = (origin + 0.5 * extents)[None]
    one = Gaussians.from_colors(
        middle, torch.full((1,), voxel), torch.full((1, 3), 0.5), label=SURFACE
    )
    return _grey(Solid(one, inside, depth, origin, voxel))


def _grey(solid: Solid) -> Solid:
    """With a neutral colour everywhere, so that parts chosen by colour can be asked for."""
    if solid.color is not None:
        return solid
    return replace(solid, color=torch.full((*solid.occupancy.shape, 3), 0.5))


def _impact_speed(body: Body, scene: Scene) -> float:
    """Speed [m/s] with which a body meets something: its own, and what falling adds."""
    own = math.sqrt(sum(v * v for v in body.velocity))
    low, _ = body.bounds()
    fall = 0.0
    if scene.floor is not None:
        fall = math.sqrt(2.0 * _GRAVITY * max(0.0, float(low[2]) - scene.floor))
    return math.hypot(own, fall)


def _flight_seconds(shot: Shot, things: int) -> float:
    """Time [s] in which nothing touches anything and no grid is needed."""
    drops = [event.height for event in shot.events if isinstance(event, Drop)]
    if not drops or things > len(shot.objects):
        return 0.0
    return math.sqrt(2.0 * min(drops) / _GRAVITY)


def _fastest(body: Body) -> float:
    parts = [part.material(body.material).wave_speed for part in body.parts]
    return max([body.material.wave_speed, *parts])


def _time_step(matter: Matter, blocks: ops.Blocks, dt: float) -> float:
    """Seconds of one transfer to the grid and back and one return map, timed here, once warm."""
    p = matter.particles
    strain_rate = torch.zeros_like(p.affine)
    seconds = math.inf
    for _ in range(2):
        start = time.perf_counter()
        grid, _ = ops.p2g(
            p.position, p.velocity, p.affine, p.mass, dx=matter.dx, blocks=blocks, dt=dt
        )
        field, _, _ = ops.grid_update(grid, dx=matter.dx, dt=dt, blocks=blocks)
        ops.g2p(field, p.position, dx=matter.dx, dt=dt, blocks=blocks)
        ops.return_mapping(
            p.strain,
            p.alpha,
            strain_rate,
            law=matter.law,
            params=matter.params,
            material=p.material,
            dt=dt,
        )
        if p.device.type == "cuda":
            torch.cuda.synchronize(p.device)
        seconds = min(seconds, time.perf_counter() - start)
    return seconds


def _memory(matter: Matter, active: int) -> int:
    values = [value for value in vars(matter.particles).values() if isinstance(value, torch.Tensor)]
    state = sum(value.numel() * value.element_size() for value in values)
    return int(_STATE_COPIES * state + 2 * active * 64 * _NODE_VALUES * 4)


def _passes(shot: Shot, scene: Scene) -> list[dict[str, Any]]:
    """Which passes the shot needs, and why."""
    laws = {
        material.law
        for body in scene.bodies
        for material in [body.material, *(part.material(body.material) for part in body.parts)]
    }
    breaks, yields = "nacc" in laws, bool(laws - {"elastic", "corotated", "rigid"})
    several = len(scene.bodies) > 1
    drops = any(isinstance(event, Drop) for event in shot.events)
    exports = [kind for kind in shot.output.what if kind != "mp4"]
    method = shot.texture.method or ("exemplar" if shot.texture.exemplar else "by default")
    rows = [
        ("reconstruct", shot.capture is not None, "photographs", "splats are given"),
        ("fill", True, "splats are a shell", ""),
        ("texture", True, f"the inside has no colours yet ({method})", ""),
        ("free flight", drops, "closed form until something is touched", "nothing falls"),
        ("contact", several, f"{len(scene.bodies)} bodies", "one body: no second velocity field"),
        ("rigid things", bool(scene.colliders), _names(scene.colliders), "only the floor"),
        ("blades", bool(scene.blades), _names(scene.blades), "nothing is cut"),
        ("return map", yields, "a material that yields", "no material yields"),
        ("repair", breaks, "cracks open", "nothing can crack"),
        ("export", bool(exports), ", ".join(exports), "only the video is asked for"),
    ]
    return [{"pass": n, "needed": need, "why": yes if need else no} for n, need, yes, no in rows]


def _names(things: Sequence[Collider | Blade]) -> str:
    return ", ".join(thing.name for thing in things)


def _warn(
    warnings: list[str], solids: list[Body], speed: float, matter: Matter, shot: Shot
) -> None:
    for body in solids:
        if not shot.events:
            warnings.append("the shot has no events: the object will only rest on the floor")
        limit = body.material.wave_speed * body.material.failure_strain
        if math.isfinite(limit) and speed < limit:
            warnings.append(
                f"{body.name}: meets something at {speed:.2g} m/s, but {body.material.name} breaks "
                f"from about {limit:.2g} m/s; raise the drop or lower cohesion"
            )
        if body.solid is not None:
            thickest = 2.0 * float(body.solid.depth.amax()) * body.frame.scale
            if thickest < 3.0 * matter.dx:
                warnings.append(
                    f"{body.name}: at most {thickest:.3g} m thick, under 3 cells of "
                    f"{matter.dx:.3g} m; use solve.quality: hero"
                )
