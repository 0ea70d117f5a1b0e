"""gsfluent's answer to a scene of FractureBench."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
import torch

from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.scenes.rows import BAND_CELLS
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.drives import Drives, damage
from gsfluent.lab.world.shapes import moduli, parameters
from gsfluent.materials import Material, opening, phase_field
from gsfluent.ops.collider import collider_row
from gsfluent.ops.plasticity import LAWS


def _phase_field(m: Mapping[str, Any], dx: float) -> torch.Tensor:
    """Parameters of a brittle row under law ``phase_field``, float64 [8]."""
    given = {key: m[key] for key in ("split", "model", "prefer") if key in m}
    young, toughness = float(m["young_modulus"]), float(m["fracture_energy"])
    strength = float(m["tensile_strength"])
    if "length" in m:
        length = float(m["length"])
        given["length"] = max(length, phase_field.CELLS * dx)
        size = phase_field.SIZE[str(m.get("model", "at1"))]
        strength = math.sqrt(size * young * toughness / length)
    material = Material(
        "bench", law="phase_field", young_modulus=young, density=float(m["density"]),
        poisson_ratio=float(m["poisson_ratio"]), toughness=toughness, tensile_strength=strength,
        **given,
    )  # fmt: skip

    def at(value: Any) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float64).reshape(1)

    return phase_field.rows(material, at, torch.ones(1, dtype=torch.float64), dx)[0]


def _rankine(m: Mapping[str, Any], dx: float) -> tuple[dict[str, float], float]:
    """Columns of a brittle row by Rankine's surface, and its alpha0.

    Strength and fracture energy are those that the row states; in compression it holds what its
    ellipse does in one axis.
    """
    mu, kappa = moduli(float(m["young_modulus"]), float(m["poisson_ratio"]))
    slope, beta = float(m["friction"]), float(m["cohesion"])
    tensile = float(m["tensile_strength"])
    p0 = kappa * math.sinh(-float(m["hardening"]) * float(m["alpha"]))
    # q = 3 p on q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0
    a = 9.0 * (1.0 + 2.0 * beta) + slope**2
    b, c = slope**2 * (beta - 1.0) * p0, -(slope**2) * beta * p0**2
    compressive = 3.0 * (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    energy = float(m["fracture_energy"]) / (BAND_CELLS * dx)
    numbers = (torch.tensor([v], dtype=torch.float64) for v in (mu, kappa, tensile, energy))
    found, xi, alpha0, _ = opening(*numbers)
    columns = {
        "c2": slope, "c3": float(found), "c4": float(xi), "c5": -max(compressive / tensile, 1.0),
    }  # fmt: skip
    return columns, float(alpha0)


def law_of(m: Mapping[str, Any], law: str = "nacc") -> str:
    """The law by which a material of a scene moves.

    Args:
        m: The material.
        law: Of what breaks: ``nacc``, ``rankine`` (NACC with that surface), ``phase_field``, or
            ``named``: the phase field for what names the width of its cracks (``length``), NACC
            for what does not.
    """
    named = "phase_field" if "length" in m else "nacc"
    found = {"named": named, "rankine": "nacc"}.get(law, law)
    return found if m["law"] == "nacc" else str(m["law"])


def rows(scene: Scene, law: str = "nacc") -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Laws int32 [M], parameters float64 [M, 8] and alpha at the start [N] of a scene.

    Args:
        scene: The scene.
        law: Of what breaks, as of :func:`law_of`.
    """
    laws, params, alpha = [], [], []
    for m in scene.materials:
        name = law_of(m, law)
        laws.append(LAWS[name])
        if name == "phase_field":
            params.append(_phase_field(m, scene.dx))
            alpha.append(-1.0)
            continue
        nacc = name == "nacc"
        columns = (
            {
                "c2": float(m["friction"]), "c3": float(m["cohesion"]),
                "c4": float(m["hardening"]), "c5": float(m.get("shear_damage", 0.0)),
            }
            if nacc
            else {}
        )  # fmt: skip
        first = float(m.get("alpha", 0.0)) if nacc else 0.0
        if nacc and law == "rankine":
            columns, first = _rankine(m, scene.dx)
        params.append(
            parameters(
                float(m["young_modulus"]), float(m["poisson_ratio"]), float(m["density"]), **columns
            )
        )
        alpha.append(first)
    start = torch.tensor(alpha, dtype=torch.float64)[torch.from_numpy(scene.material).long()]
    return torch.tensor(laws, dtype=torch.int32), torch.stack(params), start


def viscosity(scene: Scene, law: str = "nacc") -> torch.Tensor | None:
    """Viscosity of each point, float64 [N, 9], where a row yields late; None where none does.

    Args:
        scene: The scene.
        law: Of what breaks, as of :func:`law_of`; the phase field has no yield.
    """
    time = [
        float(m.get("yield_time", 0.0)) if law_of(m, law) == "nacc" else 0.0
        for m in scene.materials
    ]
    if not any(time):
        return None
    found = torch.zeros((scene.count, 9), dtype=torch.float64)
    found[:, 8] = torch.tensor(time, dtype=torch.float64)[torch.from_numpy(scene.material).long()]
    return found


def _colliders(scene: Scene) -> torch.Tensor | None:
    made = [
        collider_row(
            "plane", point=item["point"], normal=item["normal"], mode=str(item["kind"]),
            friction=float(item.get("friction", 0.0)), velocity=item.get("velocity", (0.0,) * 3),
        )
        for item in scene.colliders
    ]  # fmt: skip
    return torch.stack(made) if made else None


def _shift(scene: Scene, place: float) -> np.ndarray:
    """How far the points are moved so that the grid lies elsewhere in them [m], [3]."""
    free = np.ones(3, dtype=bool)
    for item in scene.colliders:
        free &= np.abs(np.asarray(item["normal"], dtype=np.float64)) < 1e-9
    return np.where(free, place * scene.dx, 0.0)


def _handed(name: str, world: World, alpha: torch.Tensor, drives: Drives | None) -> torch.Tensor:
    """What a scene asks for beside positions and velocities."""
    if name == "damage":
        return damage(world, alpha)
    if name == "impulse" and drives is not None:
        return torch.cat([world.impulse, drives.impulse])
    value: torch.Tensor = getattr(world, name)
    return value


def _padded(values: list[np.ndarray], count: int) -> np.ndarray | None:
    """The samples with NaN for those that a run which broke off does not have, [count, ...]."""
    if not values:
        return None
    missing = [np.full_like(values[0], math.nan)] * (count - len(values))
    return np.stack(values + missing)


def run_case(
    scene: Scene,
    *,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    cfl: float = 0.5,
    dt: float | None = None,
    engine: Literal["solver", "ops"] | None = None,
    fields: bool = True,
    place: float = 0.0,
    method: str = "gsfluent",
    law: str = "nacc",
    contact: str = "nodes",
    watch: Callable[[World, int], None] | None = None,
    setup: Callable[[World], None] | None = None,
    **options: Any,
) -> Run:
    """Run a scene by gsfluent's solver.

    Args:
        scene: The scene.
        device: Where.
        dtype: Precision of the state.
        cfl: Courant number of the automatic time step.
        dt: Fixed time step [s] instead.
        engine: As in :class:`gsfluent.lab.world.driver.World`.
        fields: A velocity field per body; False puts all into one.
        place: How far the points lie off their place on the grid [dx], along the axes that no
            collider looks along: a wall has to stay on its nodes. What is handed in does not move.
        method: Name in the record.
        law: Of what breaks, as of :func:`law_of`.
        contact: What separating colliders and other bodies push: ``nodes`` or ``points``.
        watch: ``watch(world, i)`` is called at time ``i`` of the scene, outside the measured time.
        setup: ``setup(world)`` is called once before the first step; it may wrap ``world.force``.
        **options: Further arguments of World (``k``, ``epsilon``, ``implicit``, ...).

    Returns:
        The run; one that broke off says why in ``failed``.

    Raises:
        ValueError: An argument of World is wrong.
    """
    laws, params, alpha = rows(scene, law)
    several = fields and int(scene.body.max()) > 0
    drives = Drives(scene, dtype, device) if scene.drives else None
    shift = _shift(scene, place)
    if contact == "points":
        options |= {"surface": 0.5, "touch": several}
    world = World(
        torch.from_numpy(scene.x + shift), torch.from_numpy(scene.v),
        volume=torch.from_numpy(scene.volume), dx=scene.dx, law=laws, params=params,
        material=torch.from_numpy(scene.material), alpha=alpha,
        body=torch.from_numpy(scene.body) if several else None,
        strain=None if scene.strain is None else torch.from_numpy(scene.strain),
        affine=torch.from_numpy(scene.affine), gravity=scene.gravity, colliders=_colliders(scene),
        friction=scene.friction, cfl=cfl, dt=dt, dtype=dtype, device=device, engine=engine,
        force=drives,
        deformation=bool(options.pop("deformation", False)) or "deformation" in scene.asks,
        **({"viscous": viscosity(scene, law)} | options),
    )  # fmt: skip
    if setup is not None:
        setup(world)
    count = scene.times.shape[0]
    shape = (count, scene.count, 3)
    x, v = np.full(shape, math.nan), np.full(shape, math.nan)
    asked: dict[str, list[np.ndarray]] = {name: [] for name in scene.asks}
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
        x[i] = world.position.double().cpu().numpy() - shift
        v[i] = world.velocity.double().cpu().numpy()
        for name, values in asked.items():
            values.append(_handed(name, world, alpha, drives).double().cpu().numpy())
        if watch is not None:
            watch(world, i)
    settings = {
        "dx": scene.dx, "cfl": cfl, "dt": dt, "dtype": str(dtype).removeprefix("torch."),
        "engine": world.engine, "fields": several, **({"place": place} if place else {}),
        **({} if law == "nacc" else {"law": law}),
        **({} if contact == "nodes" else {"contact": contact}), **options,
    }  # fmt: skip
    return Run(
        scene.name, method, scene.times, x, v, wall, world.steps, settings, str(device), failed,
        **{name: _padded(values, count) for name, values in asked.items()},
    )  # fmt: skip


def clock(scene: Scene, repeat: int = 3, **options: Any) -> list[float]:
    """Time a scene from its start to its last time without a stop.

    Stops at the times that a judge asks for cost a launch each; here there are none.

    Args:
        scene: The scene.
        repeat: Runs that count; one more goes before them to warm up.
        **options: Of :func:`run_case`.

    Returns:
        Seconds that the steps of each run took; infinite for one that broke off.

    Raises:
        ValueError: ``repeat`` below 1, or an argument of World is wrong.
    """
    if repeat < 1:
        raise ValueError(f"clock: repeat must be at least 1, got {repeat}")
    straight = dataclasses.replace(scene, times=scene.times[-1:])
    runs = [run_case(straight, **options) for _ in range(repeat + 1)]
    return [math.inf if run.failed else run.wall_seconds for run in runs[1:]]
