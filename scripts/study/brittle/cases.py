"""Experiments of ``run.py``: settings of every run, and what is written of it."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.frozen.answer import rows
from gsfluent.lab.peers.known import POINTS, find
from gsfluent.lab.problems.fracture import brittle
from gsfluent.lab.textbook.solver import Variant
from gsfluent.lab.world.driver import World
from gsfluent.ops.collider import collider_row

MAPS = (
    "fixed_explicit",
    "released_explicit",
    "fixed_implicit",
    "dynamic_explicit",
    "dynamic_implicit",
)
SUMS = ("plain", "sorted", "float64", "fixed")
DTYPES = {"float32": torch.float32, "float64": torch.float64}
WEAK = {**brittle.FLESH, "young_modulus": 20.0}
"""Flesh that flies apart into single points."""
MELON = {**brittle.FLESH, "young_modulus": 2e3, "cohesion": 1.0}
"""GaussianFluent's watermelon."""
RELEASED: dict[str, Any] = {
    "transfer": "flip", "flip": 0.7, "force": "twice", "storage": "F", "absolute": True,
    "return_map": "released_explicit",
}  # fmt: skip
"""What GaussianFluent's released code chooses (users.md 0 and 6.1, equations.md 0 and 3.3)."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One line of the record: one run, or two that differ in the order of sums (``pair``)."""

    part: str
    scene: str
    variant: dict[str, Any]
    dtype: str
    steps: int
    courant: float = 0.3
    mach: float = 0.0
    seed: int = 0
    away: float = 0.0
    pair: bool = False
    atomics: bool = False
    radius: float = 0.08

    @property
    def key(self) -> str:
        """What tells it from all others."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def of(cls, record: dict[str, Any]) -> Job:
        """The job that a record is of."""
        names = {f.name for f in dataclasses.fields(cls)}
        return cls(**{k: v for k, v in record.items() if k in names})


def jobs(parts: list[str], device: str, quick: bool) -> Iterator[Job]:
    """All runs, in the order in which they are made."""
    maps = ("fixed_explicit", "dynamic_implicit") if quick else MAPS
    short = ("float32",) if quick else tuple(DTYPES)
    base = {"storage": "strain"}
    # a GPU has its own disorder, and room for a larger ball
    real: dict[str, Any] = {"atomics": True, "radius": 0.2} if device == "cuda" else {}
    if "order" in parts:
        # the slowest by far comes last: its root jumps, and is sought to the end
        for name in ("elastic", *sorted(maps, key=lambda m: m == "fixed_implicit")):
            chosen = {} if name == "elastic" else {"return_map": name}
            scene = "rubber" if name == "elastic" else "drop"
            for dtype in short:
                for sums in SUMS[:2] if quick else SUMS:
                    if device == "cuda" and sums != "plain" and "float64" in (sums, dtype):
                        continue  # a minute is all there is
                    variant = {**base, **chosen, "sums": sums}
                    yield Job("order", scene, variant, dtype, 80, pair=True, **real)
        yield Job("order", "drop", {"gsfluent": True}, "float32", 80, pair=True, **real)
    if "division" in parts:
        for scene in ("drop", "half"):
            for guarded in (True, False):
                for name in maps:
                    for dtype in short:
                        for sums in ("plain", "fixed"):
                            variant = {**base, "return_map": name, "guarded": guarded, "sums": sums}
                            yield Job("division", scene, variant, dtype, 40)
        for guarded in (True, False):
            yield Job("division", "half", {**RELEASED, "guarded": guarded}, "float32", 40)
    if "debris" in parts:
        for away in (8.0, 32.0, 128.0):
            for seed in range(2 if quick else 12):
                yield Job("debris", "debris", {**base, "guarded": False}, "float32", 400,
                          seed=seed, away=away)  # fmt: skip
        more: tuple[tuple[dict[str, Any], str], ...] = (
            ({"guarded": True}, "float32"), ({"guarded": False}, "float64"),
            ({"guarded": False, "local_positions": True}, "float32"),
            ({"guarded": False, "sums": "fixed"}, "float32"),
        )  # fmt: skip
        for change, dtype in more:
            for seed in range(1 if quick else 2):
                variant = {**base, **change}
                yield Job("debris", "debris", variant, dtype, 100, seed=seed, away=32.0)
    if "ejecta" in parts:
        for name in maps[:1] if quick else ("fixed_explicit", "dynamic_implicit"):
            for guarded, dtype, seeds in (
                (False, "float32", 6), (False, "float64", 2), (True, "float32", 2)
            ):  # fmt: skip
                for seed in range(1 if quick else seeds):
                    variant = {**base, "return_map": name, "guarded": guarded}
                    steps = 150 if quick else 400
                    yield Job("ejecta", "ejecta", variant, dtype, steps, courant=0.5, seed=seed)
    if "inversion" in parts:
        for mach in (2.0,) if quick else (0.34, 1.0, 2.0, 3.0):
            for name in ("fixed_explicit", "dynamic_implicit"):
                for clamp in (None, (0.05, 20.0)):
                    for storage in ("F", "strain"):
                        variant = {"storage": storage, "return_map": name, "clamp": clamp}
                        yield Job("inversion", "drop", variant, "float32", 40, courant=0.6,
                                  mach=mach)  # fmt: skip
    if "bug" in parts:
        for wrong in (True, False):
            for name in ("fixed_explicit", "dynamic_implicit"):
                for clamp in (None, (0.05, 20.0)):
                    for storage in ("F",) if quick else ("F", "strain"):
                        for dtype in short:
                            for sums in ("plain",) if quick else ("plain", "fixed"):
                                variant = {"storage": storage, "return_map": name, "clamp": clamp,
                                           "energy_as_pressure": wrong, "sums": sums}  # fmt: skip
                                yield Job("bug", "drop", variant, dtype, 60)
    if "dt" in parts and not quick:
        for name in ("elastic", *maps):
            chosen = {} if name == "elastic" else {"return_map": name}
            for scale in (1, 2, 4):
                yield Job(
                    "dt", "rubber" if name == "elastic" else "drop", {**base, **chosen}, "float64",
                    80 * scale, courant=0.3 / scale,
                )  # fmt: skip
    if "known" in parts:
        for point in POINTS[:1] if quick else POINTS:
            yield Job("known", point.name, {}, "", 0)


PARTS = ("order", "division", "debris", "ejecta", "inversion", "bug", "dt", "known")


def scene_of(job: Job) -> Scene:
    """The scene of a job."""
    if job.scene == "debris":
        return brittle.debris(12, away=job.away, seed=job.seed)
    if job.scene == "ejecta":
        return brittle.drop(0.1, material=WEAK, shift=0.11 + 0.137 * job.seed)
    if job.scene == "half":
        return brittle.drop(0.08, per_cell=1, shift=0.0)
    material: dict[str, Any] = brittle.FLESH
    if job.scene == "rubber":
        material = {**material, "law": "elastic"}
    scene = brittle.drop(job.radius, material=material)
    if job.mach:
        scene = brittle.drop(0.08, material=material, speed=job.mach * scene.wave_speed)
    return scene


def ours(scene: Scene, job: Job, dt: float, device: str) -> list[brittle.Outcome]:
    """Two runs of gsfluent's own solver whose points are numbered differently."""
    law, params, alpha = rows(scene)
    floor = scene.colliders[0]
    made = []
    for seed in (1, 2):
        order = np.random.default_rng(seed).permutation(scene.count)
        world = World(
            torch.from_numpy(scene.x[order]), torch.from_numpy(scene.v[order]),
            mass=torch.from_numpy(scene.mass[order]), volume=torch.from_numpy(scene.volume[order]),
            dx=scene.dx, law=law, params=params, alpha=alpha, gravity=scene.gravity,
            colliders=[
                collider_row("plane", point=floor["point"], normal=floor["normal"], friction=0.3)
            ],
            dt=dt, dtype=DTYPES[job.dtype], device=device, engine="solver", irreversible=False,
        ).run(steps=job.steps)  # fmt: skip
        back = np.argsort(order)
        after = world.alpha.double().cpu().numpy()[back]
        made.append(
            brittle.Outcome(
                world.position.double().cpu().numpy()[back], after, world.steps, None,
                float((after >= 0.0).mean()), world.kinetic(), 1.0, None, 0.0, None,
            )
        )  # fmt: skip
    return made


def known(job: Job, device: str) -> dict[str, Any]:
    """A named point of a peer, with its fault and without; always on the CPU."""
    point = find(job.scene)
    value, sound = (point.measure(v, point.parameters) for v in (point.variant, point.sound))
    finite = {"value": value, "sound": sound}
    return {
        **dataclasses.asdict(job), "device": device,
        **{k: v if math.isfinite(v) else None for k, v in finite.items()},
        "failing": point.failing(value), "shown": point.shown, "birth": None,
    }  # fmt: skip


def plain(value: Any) -> Any:
    """The value with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def perform(job: Job, device: str) -> dict[str, Any]:
    """Make a run (or a pair) and return its record."""
    if job.part == "known":
        return known(job, device)
    scene = scene_of(job)
    if job.courant == 0.6:  # GaussianFluent's and PhysGaussian's rule: the speed does not count
        dt = 0.6 * scene.dx / scene.wave_speed
    elif job.scene == "debris":
        dt = 1e-3
    else:
        dt = brittle.step(scene, job.courant)
    record: dict[str, Any] = {**dataclasses.asdict(job), "device": device}
    started = time.perf_counter()
    if job.variant.get("gsfluent"):
        runs = ours(scene, job, dt, device)
    else:
        seeds = (1, 2) if job.pair else (None,)
        runs = [
            brittle.run(
                scene, Variant(**{**job.variant, "shuffle": None if job.atomics else seed}),
                steps=job.steps, dt=dt, dtype=DTYPES[job.dtype], device=device,
                every=4 if job.pair else 0, exposed=10 if job.part == "ejecta" else 0,
                judged=4 if job.part in ("division", "inversion", "bug") else 0,
            )
            for seed in seeds
        ]  # fmt: skip
    first = runs[0]
    record |= {
        "points": scene.count, "dt": dt, "seconds": time.perf_counter() - started,
        "taken": first.steps, "broken": first.broken, "kinetic": first.kinetic,
        "smallest": first.smallest, "exposure": first.exposure,
        "violation": None if first.violation is None
        else dataclasses.asdict(first.violation),
        "birth": None if first.birth is None else first.birth._asdict(),
    }  # fmt: skip
    if job.pair:
        record["rms"], record["alpha"] = brittle.apart(*runs)
        one, other = runs[0].track, runs[1].track
        if one is not None and other is not None and one.shape == other.shape:
            away = np.sqrt(((one - other) ** 2).sum(2).mean(1)) / scene.dx
            record["growth"] = [float(f"{v:.3g}") for v in away]
    if job.scene == "debris":
        local = bool(job.variant.get("local_positions"))
        record["rate"] = brittle.hit_rate(scene, DTYPES[job.dtype], local=local)
    return plain(record)
