"""gsfluent's answer to a scene of FractureBench."""

from __future__ import annotations

import math
import time
from typing import Any, Literal

import numpy as np
import torch

from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.driver import World
from gsfluent.lab.frozen_fracture import Drives, damage
from gsfluent.lab.shapes import parameters
from gsfluent.ops.collider import collider_row
from gsfluent.ops.plasticity import LAWS

__all__ = ["play", "rows"]


def rows(scene: Scene) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Laws int32 [M], parameters float64 [M, 8] and alpha at the start [N] of a scene."""
    laws, params, alpha = [], [], []
    for m in scene.materials:
        nacc = m["law"] == "nacc"
        laws.append(LAWS[str(m["law"])])
        columns = (
            {
                "c2": float(m["friction"]), "c3": float(m["cohesion"]),
                "c4": float(m["hardening"]), "c5": float(m.get("shear_damage", 0.0)),
            }
            if nacc
            else {}
        )  # fmt: skip
        params.append(
            parameters(
                float(m["young_modulus"]), float(m["poisson_ratio"]), float(m["density"]), **columns
            )
        )
        alpha.append(float(m.get("alpha", 0.0)) if nacc else 0.0)
    start = torch.tensor(alpha, dtype=torch.float64)[torch.from_numpy(scene.material).long()]
    return torch.tensor(laws, dtype=torch.int32), torch.stack(params), start


def _colliders(scene: Scene) -> torch.Tensor | None:
    made = [
        collider_row(
            "plane", point=item["point"], normal=item["normal"], mode=str(item["kind"]),
            friction=float(item.get("friction", 0.0)),
        )
        for item in scene.colliders
    ]  # fmt: skip
    return torch.stack(made) if made else None


def _handed(name: str, world: World, alpha: torch.Tensor, drives: Drives | None) -> torch.Tensor:
    """What a run hands in beside positions and velocities."""
    if name == "damage":
        return damage(world, alpha)
    if name == "impulse" and drives is not None:
        return torch.cat([world.impulse, drives.impulse])
    value: torch.Tensor = getattr(world, name)
    return value


def play(
    scene: Scene,
    *,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    cfl: float = 0.5,
    dt: float | None = None,
    engine: Literal["solver", "ops"] | None = None,
    fields: bool = True,
    method: str = "gsfluent",
    **options: Any,
) -> Run:
    """Run a scene by gsfluent's solver.

    Args:
        scene: The scene.
        device: Where.
        dtype: Precision of the state.
        cfl: Courant number of the automatic time step.
        dt: Fixed time step [s] instead.
        engine: As in :class:`gsfluent.lab.driver.World`.
        fields: A velocity field per body; False puts all into one.
        method: Name in the record.
        **options: Further arguments of World (``k``, ``epsilon``, ``implicit``, ...).

    Returns:
        The run; one that broke off says why in ``failed``.

    Raises:
        ValueError: An argument of World is wrong.
    """
    law, params, alpha = rows(scene)
    several = fields and int(scene.body.max()) > 0
    drives = Drives(scene, dtype, device) if scene.drives else None
    world = World(
        torch.from_numpy(scene.x), torch.from_numpy(scene.v), mass=torch.from_numpy(scene.mass),
        volume=torch.from_numpy(scene.volume), dx=scene.dx, law=law, params=params,
        material=torch.from_numpy(scene.material), alpha=alpha,
        body=torch.from_numpy(scene.body) if several else None,
        affine=torch.from_numpy(scene.affine), gravity=scene.gravity, colliders=_colliders(scene),
        friction=scene.friction, cfl=cfl, dt=dt, dtype=dtype, device=device, engine=engine,
        force=drives, **options,
    )  # fmt: skip
    shape = (scene.times.shape[0], scene.count, 3)
    x, v = np.full(shape, math.nan), np.full(shape, math.nan)
    more: dict[str, np.ndarray] = {}
    if bool((alpha < 0.0).any()):  # something can break
        more = {
            "damage": np.full(shape[:2], math.nan),
            "stress": np.full((*shape[:2], 6), math.nan),
        }
    acting = len(scene.colliders) + len(scene.drives)
    if acting:
        more["impulse"] = np.full((shape[0], acting, 3), math.nan)
    wall, failed = 0.0, ""
    cuda = torch.device(device).type == "cuda"
    for i, end in enumerate(scene.times):
        start = time.perf_counter()
        try:
            world.run(seconds=float(end) - world.time)
        except (FloatingPointError, ValueError) as error:
            failed = str(error).splitlines()[0]
            break
        if cuda:
            torch.cuda.synchronize()
        wall += time.perf_counter() - start
        x[i], v[i] = world.position.double().cpu().numpy(), world.velocity.double().cpu().numpy()
        for name, value in more.items():
            value[i] = _handed(name, world, alpha, drives).double().cpu().numpy()
    settings = {
        "dx": scene.dx, "cfl": cfl, "dt": dt, "dtype": str(dtype).removeprefix("torch."),
        "engine": world.engine, "fields": several, **options,
    }  # fmt: skip
    return Run(
        scene.name, method, scene.times, x, v, wall, world.steps, settings, str(device), failed,
        **more,
    )  # fmt: skip
