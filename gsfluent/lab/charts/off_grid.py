"""What leaves the grid: flight in closed form and sleep, on and off, in the simulation stage.

Two cases of their own beside those of FractureBench, since it is the stage
:class:`gsfluent.pipeline.Simulate` that takes bodies off the grid: ``flight``, a ball that is
thrown and turns (a parabola and a rigid turn), and ``rest``, a ball that lies on the floor (it
stays where it came to rest).
"""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.data import INTERIOR, Frame, Gaussians, Solid
from gsfluent.lab.charts.ladder import OFF_GRID, Setting
from gsfluent.lab.charts.record import Record, commit, machine, now
from gsfluent.lab.charts.run_case import broken
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.progress import quiet_logs
from gsfluent.scene.scene import Scene

_RADIUS, _SPIN, _VELOCITY = 0.05, 3.0, (0.5, 0.2, 1.5)
_SECONDS = {"flight": 0.3, "rest": 4.0}
_FPS = 20.0


def measure_off_grid(setting: Setting, device: str, repeat: int) -> Record:
    """Run ``flight`` or ``rest``; the time is that of all frames, with checks and figures.

    Returns:
        The record; a run that raises is one that failed.

    Raises:
        ValueError: Another case.
    """
    if setting.case not in OFF_GRID:
        raise ValueError(f"measure_off_grid: case must be one of {', '.join(OFF_GRID)}")
    try:
        return _runs(setting, device, repeat)
    except (ArithmeticError, RuntimeError, ValueError) as error:
        return broken(setting, device, error, kind="elastic", points=0,
                      seconds=_SECONDS[setting.case], knob=setting.knob)  # fmt: skip


def _runs(setting: Setting, device: str, repeat: int) -> Record:
    walls: list[float] = []
    scene = _scene(setting.case)
    for _ in range(repeat + 1):  # the first one warms up
        with quiet_logs("gsfluent.pipeline"):
            simulate = Simulate(dx=setting.dx, splats=False, device=device, **setting.options)
            coming = simulate(scene, fps=_FPS, seconds=_SECONDS[setting.case])  # samples points
        start = time.perf_counter()
        frames = list(coming)
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        walls.append(time.perf_counter() - start)
    return _record(setting, device, frames, coming.report, walls[1:])


def _record(
    setting: Setting,
    device: str,
    frames: list[SimulationFrame],
    report: dict[str, Any],
    walls: list[float],
) -> Record:
    failed = "" if report["verdict"] == "clean" else str(report["reason"])
    error, quantity = (_fallen if setting.case == "flight" else _crept)(frames)
    seconds = frames[-1].time
    middle = statistics.median(walls)
    points, steps = frames[0].particles.count, int(report["substeps"])
    measure = {"quantity": quantity, "value": error, "reference": 0.0, "error": error,
               "tolerance": 0.05, "unit": "", "source": "free fall of a rigid body"
               if setting.case == "flight" else "a body in equilibrium"}  # fmt: skip
    return Record(
        case=setting.case, kind="elastic", method=setting.method, variant=setting.variant,
        settings={"dx": setting.dx, "knob": setting.knob, "fps": _FPS, **setting.options}
        | ({} if setting.trades else {"trades": False}),
        device=device, machine=machine(device), points=points, steps=steps,
        simulated_seconds=seconds, wall_seconds=walls, wall_per_simulated=middle / seconds,
        ns_per_point_step=1e9 * middle / (points * steps) if steps else math.nan,
        error=math.inf if failed else error, measures=[measure], failed=failed, commit=commit(),
        date=now(),
    )  # fmt: skip


def _scene(case: str) -> Scene:
    scene = Scene()
    soft = materials.elastic.override(young_modulus=2e4)
    if case == "flight":
        place = Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.5]), 1.0)
        scene.add(_ball(), soft, frame=place, velocity=_VELOCITY, angular_velocity=(0, 0, _SPIN))
    else:
        scene.add(_ball(), soft, frame=Frame(torch.eye(3), torch.tensor([0, 0, _RADIUS]), 1.0))
    return scene


def _ball() -> Solid:
    """A ball of voxels about the origin, with one splat."""
    count, voxel = 26, _RADIUS / 12.0
    axis = (torch.arange(count) + 0.5 - 0.5 * count) * voxel
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    depth = (_RADIUS - grid.norm(dim=-1)).clamp(min=0.0)
    splat = Gaussians.from_colors(
        torch.zeros(1, 3), torch.full((1, 3), voxel), torch.full((1, 3), 0.5), opacities=0.9
    ).replace(labels=torch.full((1,), INTERIOR, dtype=torch.int32))
    color = torch.full((count, count, count, 3), 0.5)
    origin = torch.full((3,), -0.5 * count * voxel)
    return Solid(splat, depth > 0.0, depth, origin, voxel, color, None, {}, None)


def _fallen(frames: list[SimulationFrame]) -> tuple[float, str]:
    """Largest rms distance of the points from a rigid body on its parabola, over the radius."""
    start = frames[0].particles
    rest, mass = start.position.double(), start.mass.double()[:, None]
    center = (mass * rest).sum(dim=0) / mass.sum()
    worst = 0.0
    for frame in frames[1:]:
        t = frame.time
        c, s = math.cos(_SPIN * t), math.sin(_SPIN * t)
        turn = rest.new_tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        vx, vy, vz = _VELOCITY
        path = rest.new_tensor([vx * t, vy * t, vz * t - 0.5 * 9.81 * t * t])
        exact = (rest - center) @ turn.T + center + path
        worst = max(worst, _rms(frame.particles.position.double() - exact))
    return worst / _RADIUS, "distance from rigid free fall over the radius"


def _crept(frames: list[SimulationFrame]) -> tuple[float, str]:
    """Largest rms distance of the points in the last second from where they were at its start."""
    late = [f for f in frames if f.time >= frames[-1].time - 1.0]
    settled = late[0].particles.position.double()
    moved = max(_rms(f.particles.position.double() - settled) for f in late)
    return moved / _RADIUS, "motion in the last second of what rests, over the radius"


def _rms(gap: Tensor) -> float:
    return float(gap.square().sum(dim=1).mean().sqrt())
