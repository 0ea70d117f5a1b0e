"""Known failures of PhysGaussian's solver, reproduced from outside: named points for the maps.

python scripts/peers/failures.py PhysGaussian/mpm_solver_warp
python scripts/peers/failures.py --markdown docs/measured/peers.md

Each is a small scene with an answer that needs no reference; each runs in a process of its own,
because two of them may take it with them. `reproduced` says whether the failure was seen, so a
suspected one that does not happen is in the file as well.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import peerlib
from fracturebench.shapes import box, elastic, free
from peerlib import Floats, Placement, Scene
from physgaussian import Engine, PhysGaussian

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "docs" / "measured" / "data" / "peers_failures.json"


@dataclasses.dataclass(frozen=True)
class Point:
    """What was seen.

    Attributes:
        what: In words.
        axes: Coordinates on the maps, where it has any.
        seen: The figure.
        right: What it should be.
        reproduced: Whether that is the failure.
        note: How it showed.
    """

    what: str
    axes: dict[str, float | str]
    seen: float
    right: float
    reproduced: bool
    note: str = ""


Solver = PhysGaussian
FAILURES: dict[str, Callable[[Solver], Point]] = {}


def failure(run: Callable[[Solver], Point]) -> Callable[[Solver], Point]:
    """Register one under its name."""
    FAILURES[run.__name__] = run
    return run


def block(
    velocity: Sequence[float], dx: float = 0.05, edge: float = 0.2, corner: float = 0.0, **more: Any
) -> Scene:
    """A cube of jelly (E 1e5 Pa, 1000 kg/m^3) that moves; one second."""
    points = box([corner] * 3, [edge] * 3, dx, 8)
    row = more.pop("row", elastic(1e5, 0.3, 1000.0))
    return free("block", points, velocity, dx, 8, np.array([1.0]), row, **more)


def mean_speed(engine: Engine, of: Any = slice(None)) -> Floats:
    """Mean velocity of some points [m/s], [3]."""
    return engine.state()[1][of].mean(axis=0)


@failure
def stagnation(solver: Solver) -> Point:
    """x + v dt is x where v dt is below half a unit in the last place: float32 positions."""
    scene, dt, count = block([0.005, 0.0, 0.0]), 1e-5, 2000
    placed = Placement(40, 0.05, np.full(3, -28, np.int64))  # the cube lies from 1.4 m to 1.6 m
    engine = Engine(solver, scene, "shipped", "cpu", placed)
    engine.advance(count, dt)
    moved = float((engine.state()[0] - scene.x)[:, 0].mean()) / (0.005 * dt * count)
    return Point(
        "a body at 5 mm/s, 1.5 m from the origin, dt 1e-5 s: way over the way it should go",
        {"distance_m": 1.5, "dt_s": dt, "speed_m_s": 0.005}, moved, 1.0, abs(moved - 1.0) > 0.05,
    )  # fmt: skip


@failure
def rotation_drift(solver: Solver) -> Point:
    """F grows by round-off in plain rotation: strain of a ball that only turns slowly."""
    from fracturebench.shapes import ball

    x, volume = ball(0.1, 0.025, 8)
    omega, dt, count = 0.5, 1e-4, 10000
    turn = np.array([[0.0, -omega, 0.0], [omega, 0.0, 0.0], [0.0, 0.0, 0.0]])
    scene = free(
        "turning", x, x @ turn.T, 0.025, 8, np.array([1.0]), elastic(1e6, 0.3, 1000.0),
        volume=volume, affine=np.broadcast_to(turn, (len(x), 3, 3)).copy(),
    )  # fmt: skip
    engine = Engine(solver, scene, "shipped", "cpu")
    engine.advance(count, dt)
    f = engine.solver.mpm_state.particle_F.numpy().astype(np.float64)
    strain = 0.5 * (np.einsum("nki,nkj->nij", f, f) - np.eye(3))
    young, nu = 1e6, 0.3
    mu, lam = peerlib.lame(young, nu)
    trace = np.einsum("nii->n", strain)
    stored = float((volume * (mu * (strain**2).sum((1, 2)) + 0.5 * lam * trace**2)).sum())
    # what turning really stores is the square of rho (w R)^2 / E over that of the turning itself
    kinetic = 0.5 * 1000.0 * float((volume * ((x @ turn.T) ** 2).sum(1)).sum())
    right = 1000.0 * (omega * 0.1) ** 2 / young
    return Point(
        "a ball turning once in 12.6 s, E 1e6 Pa: elastic over kinetic energy after 10,000 steps",
        {"young_modulus": young, "steps": count, "storage": "F", "dtype": "float32"},
        stored / kinetic, right, stored / kinetic > 10.0 * right,
        f"mean strain {math.sqrt(float((strain**2).sum((1, 2)).mean())):.1e}",
    )  # fmt: skip


@failure
def pull_apart(solver: Solver) -> Point:
    """Two touching blocks that leave each other stay glued: one velocity field."""
    from fracturebench.registry import find

    case = find("pull_apart")
    scene = case.build(0.01, 8)
    dt = 0.37 * scene.dx / scene.wave_speed
    run = peerlib.play(solver, scene, variant="shipped", device="cpu", dt=dt, repeat=0)
    kept = next(iter(case.judge(scene, run))).value
    return Point(
        "two touching blocks leaving at v = 0.01 c: speed kept",
        {"fields": 1, "v_over_c": 0.01, "dx_m": scene.dx}, kept, 1.0, abs(kept - 1.0) > 1e-3,
    )  # fmt: skip


@failure
def slip_wall_sticks(solver: Solver) -> Point:
    """Its surface collider stops a node wholly, whatever kind it is given."""
    scene = block([0.5, 0.0, -0.1])
    engine = Engine(solver, scene, "shipped", "cpu", Placement(24, 0.05, np.full(3, -10, np.int64)))
    engine.solver.add_surface_collider((0.5, 0.5, 0.5), (0.0, 0.0, 1.0), "slip", 0.0)
    engine.advance(400, 5e-4)
    kept = float(mean_speed(engine)[0]) / 0.5
    return Point(
        "a block that slides on a plane given as `slip`: share of its speed after 0.2 s",
        {"collider": "slip", "friction": 0.0}, kept, 1.0, kept < 0.9,
    )  # fmt: skip


@failure
def leaves_the_grid(solver: Solver) -> Point:
    """Grid indices are not checked: matter that flies out writes where it should not."""
    scene = block([20.0, 0.0, 0.0])
    engine = Engine(solver, scene, "shipped", "cpu", Placement(16, 0.05, np.full(3, -6, np.int64)))
    engine.advance(400, 1e-3)
    x = engine.solver.mpm_state.particle_x.numpy()
    far = float(np.abs(x[np.isfinite(x).all(axis=1)]).max(initial=0.0))
    finite = bool(np.isfinite(x).all())
    right = 0.6 + 20.0 * 0.4
    return Point(
        "a body that flies out of the domain at 20 m/s for 0.4 s: farthest coordinate [m]",
        {"out_of_domain": 1}, far, right, not finite or abs(far - right) > 0.5,
        "" if finite else "positions are not finite",
    )  # fmt: skip


@failure
def half_cell(solver: Solver) -> Point:
    """A lone point at (n + 1/2) dx, one of whose weights is exactly 0 (0/0 in its fork's FLIP)."""
    dx = 0.0625
    x = np.array([[0.5 * dx, 0.5 * dx, 0.5 * dx]])
    scene = free("point", x, [0.1, 0.0, 0.0], dx, 1, np.array([1.0]), elastic(1e5, 0.3, 1000.0))
    engine = Engine(solver, scene, "shipped", "cpu")
    engine.advance(10, 1e-3)
    speed = float(mean_speed(engine)[0]) / 0.1
    return Point(
        "a lone point at (n + 1/2) dx: speed kept over 10 steps",
        {"offset_dx": 0.5}, speed if math.isfinite(speed) else -1.0, 1.0,
        not math.isfinite(speed) or abs(speed - 1.0) > 1e-3,
    )  # fmt: skip


def limit(solver: Solver, row: dict[str, Any], courants: Sequence[float]) -> float:
    """Greatest of some Courant numbers at which a jolted free cube keeps its energy bounded."""
    best = 0.0
    rng = np.random.default_rng(0)
    for courant in courants:
        scene = block([0.0, 0.0, 0.0], row=row)
        v = 1e-3 * scene.wave_speed * rng.standard_normal(scene.x.shape)
        scene = dataclasses.replace(scene, v=v)
        engine = Engine(solver, scene, "shipped", "cpu")
        engine.advance(1000, courant * scene.dx / scene.wave_speed)
        try:
            speed = float((engine.state()[1] ** 2).mean())
        except peerlib.Cannot:
            break
        if not speed <= float((v**2).mean()):
            break
        best = courant
    return best


@failure
def step_limit(solver: Solver) -> Point:
    """Where its explicit step blows up; its configs go up to 0.37 and are chosen by hand."""
    tried = (0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3)
    seen = limit(solver, elastic(1e5, 0.3, 1000.0), tried)
    return Point(
        "greatest c dt/dx at which a jolted free cube (nu 0.3) stays bounded for 1,000 steps",
        {"courant": seen, "poisson_ratio": 0.3}, seen, 0.5, seen < 0.5,
        "the step is the user's own number: nothing checks it against the wave",
    )  # fmt: skip


@failure
def stiffness_ratio(solver: Solver) -> Point:
    """A step that suits the soft half of a body breaks the stiff one: dt is one number by hand."""
    dx = 0.05
    points = box([0.0, 0.0, 0.0], [0.4, 0.2, 0.2], dx, 8)
    soft, stiff = elastic(1e4, 0.3, 1000.0), elastic(1e6, 0.3, 1000.0)
    scene = free(
        "halves", points, 1e-2 * np.sin(40.0 * points), dx, 8, np.array([1.0]), (soft, stiff),
        material=(points[:, 0] > 0.2).astype(float),
    )  # fmt: skip
    engine = Engine(solver, scene, "shipped", "cpu")
    slow = math.sqrt(1e4 * 0.7 / (1.3 * 0.4) / 1000.0)
    dt = 0.37 * dx / slow
    engine.advance(200, dt)
    try:
        v = engine.state()[1]
        grown = float(np.sqrt((v**2).mean() / (scene.v**2).mean()))
    except peerlib.Cannot:
        grown = math.inf
    bad = not grown < 1.0
    return Point(
        "two halves of E 1:100, c dt/dx 0.37 of the soft one: rms speed over that at the start",
        {"young_ratio": 100.0, "density_ratio": 1.0, "courant_soft": 0.37},
        grown if math.isfinite(grown) else 1e9, 1.0, bad, "1e9 stands for a run that broke off",
    )  # fmt: skip


@failure
def small_steps_damp(solver: Solver) -> Point:
    """Every APIC step costs amplitude, so shorter steps damp more: its demos go down to 0.013."""
    from fracturebench.registry import find

    case = find("bar")
    scene = case.build(1 / 8, 8)
    left = []
    for courant in (0.37, 0.013):
        dt = courant * scene.dx / scene.wave_speed
        run = peerlib.play(solver, scene, variant="shipped", device="cpu", dt=dt, repeat=0)
        left.append(list(case.judge(scene, run))[1].value)
    return Point(
        "vibrating bar, 8 cells: amplitude in the third period at c dt/dx 0.013 over that at 0.37",
        {"courant": 0.013, "courant_other": 0.37}, left[1] / left[0], 1.0,
        left[1] < 0.9 * left[0], f"{left[1]:.3f} against {left[0]:.3f}",
    )  # fmt: skip


def one(folder: Path, name: str) -> dict[str, Any]:
    """Run one here."""
    solver = PhysGaussian()
    version = solver.load(folder)
    return {"name": name, "peer": solver.name, "version": version} | dataclasses.asdict(
        FAILURES[name](solver)
    )


def guarded(folder: Path, name: str) -> dict[str, Any]:
    """Run one in a process of its own; what ends the process is what was seen."""
    command = [sys.executable, str(Path(__file__).resolve()), str(folder), "--one", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode == 0 and lines:
        return dict(json.loads(lines[-1]))
    about = (FAILURES[name].__doc__ or name).strip().splitlines()[0]
    tail = done.stderr.strip().splitlines()[-1:] or [""]
    died = done.returncode < 0
    return {"name": name, "peer": PhysGaussian.name, "version": "", "what": about, "axes": {},
            "seen": float(done.returncode), "right": 0.0, "reproduced": died,
            "note": f"the process ended with signal {-done.returncode}" if died else tail[0],
        }  # fmt: skip


def table(found: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    out = ["| name | what | seen | right | reproduced | |", "| --- | --- | --- | --- | --- | --- |"]
    for p in found:
        out.append(
            f"| {p['name']} | {p['what']} | {p['seen']:.4g} | {p['right']:.4g} | "
            f"{'yes' if p['reproduced'] else 'no'} | {p['note']} |"
        )
    return "\n".join(out)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", help="mpm_solver_warp of a checkout")
    parser.add_argument("-o", "--out", type=Path, default=DATA)
    parser.add_argument("--one", choices=sorted(FAILURES), help="only this, here, as JSON")
    parser.add_argument("--markdown", type=Path, help="enter the file's table into this page")
    options = parser.parse_args(arguments)
    if options.folder is not None:
        missing = peerlib.absent(PhysGaussian())
        if missing:
            sys.stdout.write(missing + "\n")
            return 0
        if options.one:
            sys.stdout.write("\n" + json.dumps(one(options.folder, options.one)) + "\n")
            return 0
        found = []
        for name in FAILURES:
            found.append(guarded(options.folder, name))
            sys.stderr.write(f"{name}: {found[-1]['seen']:.4g} {found[-1]['note']}\n")
        options.out.parent.mkdir(parents=True, exist_ok=True)
        temporary = options.out.with_name(options.out.name + ".tmp")
        temporary.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        temporary.replace(options.out)
    if options.markdown is not None:
        sys.path.insert(0, str(ROOT))
        from gsfluent.figure.markdown import enter

        text = options.markdown.read_text(encoding="utf-8")
        part = table(json.loads(options.out.read_text(encoding="utf-8")))
        options.markdown.write_text(enter(text, "failures", part), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
