"""What the adapters in this folder share: placing a scene in a peer's domain, stepping, jobs.

Imports NumPy and FractureBench's format only, so that it runs in a peer's own environment.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

# the format of this checkout, last on the path so that it hides nothing; a folder of that name
# elsewhere on it is no package
sys.path.append(str(Path(__file__).resolve().parents[2] / "gsfluent"))
if getattr(sys.modules.get("fracturebench"), "__file__", None) is None:
    sys.modules.pop("fracturebench", None)

from fracturebench.run import Run
from fracturebench.scene import Scene

Floats = NDArray[np.float64]
# a node on a wall is the wall's in the scenes; peers take those strictly below a plane, so a plane
# is given to them by this share of a cell higher
NODE_ON_WALL = 1e-3
MARGIN = 4  # cells between the matter and the side of a bounded domain


class Cannot(Exception):
    """A scene that a peer has no means to represent; the message says which part of it."""


def lame(young: Floats | float, poisson: Floats | float) -> tuple[Any, Any]:
    """Lame's parameters (mu, lambda) [Pa] of Young's modulus [Pa] and Poisson's ratio."""
    mu = young / (2.0 * (1.0 + poisson))
    return mu, young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


def per_point(scene: Scene, key: str) -> Floats:
    """A material parameter of every point, [N]."""
    rows = np.array([float(m[key]) for m in scene.materials])
    return rows[scene.material]


def only_elastic(scene: Scene) -> None:
    """Raise Cannot unless every law is ``elastic`` and nothing is driven."""
    for row in scene.materials:
        if row["law"] != "elastic":
            raise Cannot(f"has no law {row['law']!r}")
    if scene.drives:
        raise Cannot("cannot prescribe the velocity of chosen points")


def swept(scene: Scene) -> tuple[Floats, Floats]:
    """Lower and upper corner [m] of where the bodies get by flying on, walls not counted."""
    low, high = scene.x.min(axis=0), scene.x.max(axis=0)
    t = scene.seconds
    for body in np.unique(scene.body):
        of = scene.body == body
        mass = scene.mass[of][:, None]
        mean = (mass * scene.v[of]).sum(axis=0) / mass.sum()
        way = mean * t + 0.5 * np.array(scene.gravity) * t * t
        # a body that turns fills a ball about its centre
        centre = 0.5 * (scene.x[of].min(axis=0) + scene.x[of].max(axis=0))
        if np.abs(scene.v[of] - mean).max() > 1e-2 * scene.wave_speed:
            reach = np.full(3, float(np.linalg.norm(scene.x[of] - centre, axis=1).max()))
            low, high = np.minimum(low, centre - reach), np.maximum(high, centre + reach)
        low = np.minimum(low, scene.x[of].min(axis=0) + np.minimum(way, 0.0))
        high = np.maximum(high, scene.x[of].max(axis=0) + np.maximum(way, 0.0))
    for plane in scene.colliders:
        normal, point = np.array(plane["normal"], float), np.array(plane["point"], float)
        axis = int(np.abs(normal).argmax())
        if normal[axis] > 0.0:
            low[axis] = max(low[axis], point[axis])
        else:
            high[axis] = min(high[axis], point[axis])
    return low, high


@dataclasses.dataclass(frozen=True)
class Placement:
    """A scene in a cube of ``n`` cells whose corner is the origin, moved by whole cells.

    Attributes:
        n: Cells along an edge.
        dx: Node spacing [m].
        shift: Node of the scene that becomes node 0, [3].
    """

    n: int
    dx: float
    shift: NDArray[np.int64]

    @property
    def size(self) -> float:
        """Edge of the cube [m]."""
        return self.n * self.dx

    def inward(self, x: Floats) -> Floats:
        """Positions of the scene in the peer's domain."""
        return x - self.shift * self.dx

    def outward(self, x: Floats) -> Floats:
        """Positions of the peer in the scene."""
        return x + self.shift * self.dx

    def holds(self, x: Floats) -> bool:
        """Whether all positions (of the peer) keep a stencil's distance from the sides."""
        return bool((x > 1.5 * self.dx).all() and (x < self.size - 1.5 * self.dx).all())


def place(scene: Scene, margin: int = MARGIN) -> Placement:
    """The smallest cube of cells that holds the motion, the scene's nodes falling on its nodes."""
    low, high = swept(scene)
    first = np.floor(low / scene.dx + 1e-9).astype(np.int64) - margin
    last = np.ceil(high / scene.dx - 1e-9).astype(np.int64) + margin
    n = int((last - first).max())
    # room that the longest side leaves to the others is shared between both of their ends
    return Placement(n, scene.dx, first - (n - (last - first)) // 2)


def intervals(times: Floats, dt: float) -> list[tuple[int, float]]:
    """Steps and their length between the asked times: the largest step not above ``dt``."""
    spans = np.diff(np.concatenate([[0.0], times]))
    # equal spans get one and the same step, whatever the last digit of their difference
    counts = [max(0, math.ceil(span / dt - 1e-6)) for span in spans]
    same = bool(np.allclose(spans, spans[-1], rtol=1e-9, atol=0.0))
    step = float(times[-1]) / len(times)
    return [
        (n, (step if same else float(span)) / n if n else 0.0)
        for n, span in zip(counts, spans, strict=True)
    ]


class Engine(Protocol):
    """A peer that holds one scene."""

    steps: int

    def advance(self, count: int, dt: float) -> None:
        """Take steps [s] and wait until they are done."""

    def state(self) -> tuple[Floats, Floats]:
        """Positions and velocities of the scene, [N, 3] each."""


def method(peer: Peer, variant: str) -> str:
    """Name in the records: the peer as its users run it has the plain name."""
    return peer.name if variant == peer.shipped else f"{peer.name}, {variant}"


class Peer(Protocol):
    """An adapter.

    Attributes:
        name: In the records.
        shipped: The variant that its users run.
        needs: Module that must be importable.
        install: How to get it.
        variants: Ways to run it, by device: ``cpu`` and ``cuda``.
        courant: Courant numbers of a chart's ladder.
    """

    name: str
    shipped: str
    needs: str
    install: str
    variants: Mapping[str, Sequence[str]]
    courant: Sequence[float]

    def load(self, folder: Path | None) -> str:
        """Import it; return its version."""

    def start(self, scene: Scene, variant: str, device: str) -> Engine:
        """Put a scene into it; raise Cannot where it has no means."""


def failed_run(scene: Scene, name: str, reason: str, device: str, **settings: Any) -> Run:
    """A run that says why there is none."""
    nothing = np.full((scene.times.shape[0], scene.count, 3), math.nan)
    plain = {"dx": scene.dx, **settings}
    return Run(scene.name, name, scene.times, nothing, nothing, 0.0, 0, plain, device, reason)


def merged(plan: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """The same steps without stops: neighbours of one length are one stretch."""
    out: list[tuple[int, float]] = []
    for count, dt in plan:
        if out and (out[-1][1] == dt or not count):
            out[-1] = (out[-1][0] + count, out[-1][1])
        elif count:
            out.append((count, dt))
    return out


def play(
    peer: Peer, scene: Scene, *, variant: str, device: str, dt: float, repeat: int = 1, **extra: Any
) -> Run:
    """Run a scene by a peer: two steps to compile, a run for the error, ``repeat`` for the time.

    A stop to look at the state costs what a few steps cost; so the timed runs go straight to the
    last time. The wall time is their median, all of them are kept in ``settings["walls"]``; with
    ``repeat`` 0 it is the time of the steps of the run with stops.
    """
    settings = {
        "dt": dt, "courant": scene.wave_speed * dt / scene.dx, "variant": variant, **extra,
        "dtype": "float32", "fields": False,
        "timing": "uninterrupted" if repeat else "between samples",
    }  # fmt: skip
    plan, name = intervals(scene.times, dt), method(peer, variant)
    try:
        peer.start(scene, variant, device).advance(2, plan[-1][1])  # compiles
        engine = peer.start(scene, variant, device)
        settings |= getattr(engine, "settings", {})
        x, v, wall, failed = drive(engine, scene, plan)
        walls = [wall]
        if not failed and repeat:
            walls = [clock(peer.start(scene, variant, device), plan) for _ in range(repeat)]
    except Cannot as reason:
        return failed_run(scene, name, f"{peer.name} {reason}", device, **settings)
    except Exception as error:  # whatever it raises is what its user would get
        if hasattr(peer, "forget"):
            peer.forget()
        told = (str(error).strip().splitlines() or [""])[0]
        return failed_run(scene, name, f"{type(error).__name__}: {told}", device, **settings)
    settings |= {"dx": scene.dx, "walls": walls, "dt": plan[-1][1]}
    wall = float(np.median(walls))
    return Run(scene.name, name, scene.times, x, v, wall, engine.steps, settings, device, failed)


def prepare(engine: Engine, plan: Sequence[tuple[int, float]]) -> None:
    """Let an engine make what it needs for the steps of a plan, such as CUDA graphs, untimed."""
    if hasattr(engine, "prepare"):
        for dt in sorted({dt for count, dt in plan if count}):
            engine.prepare(dt)


def clock(engine: Engine, plan: Sequence[tuple[int, float]]) -> float:
    """Wall seconds of all steps of a plan, without a stop."""
    stretches = merged(plan)
    prepare(engine, stretches)
    start = time.perf_counter()
    for count, dt in stretches:
        engine.advance(count, dt)
    return time.perf_counter() - start


def drive(
    engine: Engine, scene: Scene, plan: Sequence[tuple[int, float]]
) -> tuple[Floats, Floats, float, str]:
    """Step through the asked times: positions, velocities, wall seconds, why it broke off."""
    shape = (scene.times.shape[0], scene.count, 3)
    x, v = np.full(shape, math.nan), np.full(shape, math.nan)
    wall = 0.0
    prepare(engine, plan)
    for i, (count, dt) in enumerate(plan):
        try:
            if count:
                start = time.perf_counter()
                engine.advance(count, dt)
                wall += time.perf_counter() - start
            position, velocity = engine.state()
        except Cannot as reason:
            return x, v, wall, f"{reason} before t = {scene.times[i]:.4g} s"
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            return x, v, wall, f"not finite before t = {scene.times[i]:.4g} s"
        x[i], v[i] = position, velocity
    return x, v, wall, ""


def absent(peer: Peer) -> str:
    """Why a peer cannot be run here, and how to get it; empty if it is there."""
    if importlib.util.find_spec(peer.needs) is None:
        return f"{peer.name}: skipped, no module {peer.needs!r} here. {peer.install}"
    return ""


def parser(peer: Peer, description: str) -> argparse.ArgumentParser:
    """The command line that all adapters share."""
    made = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--scene", type=Path, help="a frozen scene (.npz)")
    made.add_argument("--out", type=Path, help="where the run goes (.npz)")
    made.add_argument("--jobs", type=Path, help="instead: a JSON line per run, as all.py writes")
    made.add_argument("--folder", type=Path, help="the peer's checkout, where it has one")
    made.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    made.add_argument("--dt", type=float, help="step [s]; or")
    made.add_argument("--courant", type=float, default=peer.courant[0])
    known = {v for d in peer.variants.values() for v in d} | set(getattr(peer, "tried", ()))
    made.add_argument("--variant", choices=sorted(known))
    made.add_argument("--repeat", type=int, default=1)
    return made


def main(peer: Peer, description: str, arguments: Sequence[str] | None = None) -> int:
    """Run one scene or a list of jobs; an absent peer is said and is no error."""
    command = parser(peer, description)
    options = command.parse_args(arguments)
    if options.jobs is None and (options.scene is None or options.out is None):
        command.error("give --scene and --out, or --jobs")
    missing = absent(peer)
    if missing:
        sys.stdout.write(missing + "\n")
        return 0
    try:
        version = peer.load(options.folder)
    except (ImportError, FileNotFoundError) as error:
        sys.stdout.write(f"{peer.name}: skipped, {error}. {peer.install}\n")
        return 0
    if options.jobs is not None:
        lines = options.jobs.read_text(encoding="utf-8").splitlines()
        jobs = [json.loads(line) for line in lines if line.strip()]
    else:
        variant = options.variant or peer.variants[options.device][0]
        jobs = [{"scene": str(options.scene), "out": str(options.out), "variant": variant,
                 "courant": options.courant, "dt": options.dt, "repeat": options.repeat},
        ]  # fmt: skip
    begin, path, scene = time.perf_counter(), "", None
    for i, job in enumerate(jobs, 1):
        out = Path(job["out"])
        if out.is_file():
            continue
        if scene is None or path != job["scene"]:
            path, scene = job["scene"], Scene.load(job["scene"])
        dt = job.get("dt") or job["courant"] * scene.dx / scene.wave_speed
        run = play(
            peer, scene, variant=job["variant"], device=options.device, dt=dt,
            repeat=job.get("repeat", 1), version=version,
        )  # fmt: skip
        run.save(out)
        done = run.failed or f"{run.wall_seconds:.3f} s, {run.steps} steps"
        sys.stderr.write(
            f"{peer.name} {i}/{len(jobs)} {out.stem}: {done} "
            f"[{time.perf_counter() - begin:.0f} s]\n"
        )
    return 0
