"""What PhysGaussian's own demo settings cost, and what the same error costs in gsfluent.

python scripts/peers/demo_settings.py peer PhysGaussian -o demo.jsonl [--device cuda]  # its env
python scripts/peers/demo_settings.py ours PhysGaussian -o demo.jsonl [--device cuda]  # gsfluent's
python scripts/peers/demo_settings.py table demo.jsonl --markdown docs/measured/peers.md

PhysGaussian is the folder of a checkout. `peer` runs its solver at exactly each config's grid, step
and matter on the stand-in of demo_scenes.py: error against the exact mode, and wall milliseconds
per simulated millisecond, as shipped and as a CUDA graph. On the CPU its steps are only timed
(--steps of them): a run takes days, and the error is the device's. `ours` looks for gsfluent's
cheapest setting with at most that error, which it takes from the same file, and adds the price of
moving the Gaussians with the points once a frame. Resumable: a JSON line per run.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import demo_scenes
import numpy as np
import peerlib
from demo_scenes import Mode, Setting
from peerlib import Run, Scene

CELLS = (
    2,
    2.5,
    3,
    3.5,
    4,
    5,
    6,
    7,
    8,
    10,
    12,
    14,
    16,
    20,
    24,
    28,
)  # of ours across the thinnest side
OURS = tuple((cfl, ppc) for ppc in (1, 2, 8) for cfl in (0.9, 0.5))
MATTER = ("pipeline", "lattice")
NO_ANSWER = 1.0  # the error of a body that stands still
Choice = tuple[float, float, float]  # CFL, points per cell, cells across the thinnest side


def lines(path: Path) -> list[dict[str, Any]]:
    """The records of a file, none if it is not there."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def add(path: Path, record: Mapping[str, Any]) -> None:
    """Append one record."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record, allow_nan=False) + "\n")


def where(device: str, gpu: Callable[[], str]) -> str:
    """Name of the machine."""
    if device == "cuda":
        return gpu()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{platform.processor() or platform.machine()}, {cores} cores"


def record(
    setting: Setting, method: str, matter: str, scene: Scene, *, device: str, machine: str,
    steps: int, walls: Sequence[float], per_simulated: float, error: float, timed: int = 0,
    failed: str = "", commit: str = "", **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """A line as gsfluent.lab.charts.record has them; ``timed`` steps took the walls, or all did."""
    bad = failed or not math.isfinite(error)
    return {
        "case": f"demo_{setting.name}", "kind": "elastic", "method": method, "variant": matter,
        "settings": {"dx": scene.dx, "dt": setting.dt, "n_grid": setting.n_grid, **more},
        "device": device, "machine": machine, "points": scene.count, "steps": steps,
        "simulated_seconds": scene.seconds, "wall_seconds": list(walls),
        "wall_per_simulated": per_simulated,
        "ns_per_point_step": 1e9 * float(np.median(walls)) / scene.count / max(1, timed or steps),
        "error": None if bad else error, "measures": [], "failed": failed, "commit": commit,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }  # fmt: skip


def key(line: Mapping[str, Any]) -> tuple[str, ...]:
    """What makes two lines the same run."""
    return tuple(str(line[k]) for k in ("case", "method", "variant", "device"))


def timed(engine: Any, count: int, dt: float, repeat: int) -> list[float]:
    """Wall seconds of so many steps, after as many as a tenth of them."""
    engine.advance(max(2, count // 10), dt)
    out = []
    for _ in range(repeat):
        start = time.perf_counter()
        engine.advance(count, dt)
        out.append(time.perf_counter() - start)
    return out


def peer(options: argparse.Namespace, chosen: Iterable[Setting]) -> int:
    """Run PhysGaussian at its own settings."""
    from physgaussian import Engine, PhysGaussian

    solver = PhysGaussian()
    missing = peerlib.absent(solver)
    if missing:
        sys.stdout.write(missing + "\n")
        return 0
    version = solver.load(options.checkout / "mpm_solver_warp")
    gpu = options.device == "cuda"

    def name() -> str:
        import torch

        return str(torch.cuda.get_device_name())

    machine, done = where(options.device, name), {key(line) for line in lines(options.out)}
    for setting in chosen:
        mode = Mode(setting)
        for matter in options.matter:
            case = f"demo_{setting.name}"
            variants = [
                v for v in solver.variants[options.device]
                if (case, peerlib.method(solver, v), matter, options.device) not in done
            ]  # fmt: skip
            if not variants:
                continue
            if matter != "lattice":
                x, volume = demo_scenes.pipeline(setting, options.gaussians)
            else:
                x, volume = demo_scenes.lattice(setting, setting.dx, 8)
            scene = demo_scenes.scene(setting, x, volume, setting.dx, mode)
            placed = demo_scenes.domain(setting)
            error, failed, steps = math.inf, "only timed here", 0
            facts = {"mass_over_exact": float(volume.sum() / np.prod(setting.size))}
            if gpu:
                engine = Engine(solver, scene, "graph", options.device, placed)
                engine.advance(1, setting.dt)
                engine = Engine(solver, scene, "graph", options.device, placed)
                plan = peerlib.intervals(scene.times, setting.dt)
                x_all, v_all, _, failed = peerlib.drive(engine, scene, plan)
                run = Run(scene.name, "", scene.times, x_all, v_all, 0.0, 0, {}, "", failed)
                error, steps = demo_scenes.error(scene, run, mode), engine.steps
                if not failed:
                    u = demo_scenes.displacement(scene, run, mode)
                    facts["frequency_over_exact"] = demo_scenes.pitch(scene.times, u, mode.omega)
            for variant in variants:
                engine = Engine(solver, scene, variant, options.device, placed)
                count = options.steps or (200 if gpu else 3)
                walls = timed(engine, count, setting.dt, 3)
                per_step = float(np.median(walls)) / count
                add(options.out, record(
                    setting, peerlib.method(solver, variant), matter, scene,
                    device=options.device, machine=machine, steps=steps or count, walls=walls,
                    per_simulated=per_step / setting.dt, error=error, failed=failed,
                    courant=scene.wave_speed * setting.dt / scene.dx,
                    commit=version, timed=count, timed_steps=count,
                    ms_per_step=1e3 * per_step,
                    gaussians=options.gaussians, **facts,
                ))  # fmt: skip
                sys.stderr.write(
                    f"{case} {matter} {variant}: {scene.count:,} points, {1e3 * per_step:.3f} ms "
                    f"a step, {per_step / setting.dt:.4g} ms/ms, error {error:.4f} {failed}\n"
                )
    return 0


def riding(setting: Setting, x: Any, width: float, options: argparse.Namespace) -> float:
    """Seconds to move all Gaussians with the points once: gsfluent's own op, median of five."""
    import torch
    from scipy.spatial import cKDTree

    from gsfluent import ops

    places, _ = demo_scenes.pipeline(setting, options.gaussians)
    places = places[: options.gaussians]  # fill points carry no splat
    tree = cKDTree(x)
    device = torch.device(options.device)

    def on(value: Any, dtype: Any = torch.float32) -> Any:
        return torch.as_tensor(value, dtype=dtype, device=device).contiguous()

    near = on(tree.query(x, k=8)[1], torch.int64)
    n = x.shape[0]
    maps = torch.eye(3, device=device).expand(n, 3, 3).contiguous()
    parted = torch.zeros(n, 8, dtype=torch.bool, device=device)
    arguments = (on(places), on(tree.query(places)[1], torch.int64), near, parted, on(x), on(x),
                 maps, on(np.full(n, width)))  # fmt: skip
    walls = []
    for _ in range(6):
        start = time.perf_counter()
        ops.carry_place(*arguments)
        if device.type == "cuda":
            torch.cuda.synchronize()
        walls.append(time.perf_counter() - start)
    return float(np.median(walls[1:]))


def target(found: Sequence[Mapping[str, Any]], setting: Setting, matter: str) -> float:
    """The largest error that ours may have: PhysGaussian's, or half of one that is no answer."""
    errors = [
        float(line["error"]) for line in found
        if line["case"] == f"demo_{setting.name}" and line["variant"] == matter
        and line["method"].startswith("physgaussian") and line["error"] is not None
    ]  # fmt: skip
    worst = max(errors) if errors else 0.0
    return worst if worst < NO_ANSWER else 0.5 * NO_ANSWER


class Search:
    """Runs of gsfluent on one setting, each made once."""

    def __init__(self, setting: Setting, device: str) -> None:
        self.setting, self.device, self.mode = setting, device, Mode(setting)
        self.made: dict[Choice, tuple[float, int, float]] = {}

    def scene(self, choice: Choice) -> Scene:
        """The stand-in at (cfl, points per cell, cells across)."""
        _, ppc, cells = choice
        dx = float(self.setting.size.min()) / cells
        matter = demo_scenes.lattice(self.setting, dx, int(ppc))
        return demo_scenes.scene(self.setting, *matter, dx, self.mode)

    def error(self, choice: Choice) -> float:
        """Error of a run."""
        import torch

        from gsfluent.lab.frozen.answer import run_case

        if choice not in self.made:
            scene = self.scene(choice)
            run = run_case(scene, device=self.device, dtype=torch.float32, cfl=choice[0])
            error = demo_scenes.error(scene, run, self.mode)
            self.made[choice] = error, run.steps, run.wall_seconds
        return self.made[choice][0]

    def reaching(self, wanted: float) -> list[Choice]:
        """Of every CFL and count the coarsest that has at most an error."""
        out = []
        for cfl, ppc in OURS:
            for i in range(1, len(CELLS), 2):
                if self.error((cfl, ppc, CELLS[i])) <= wanted:
                    coarser = self.error((cfl, ppc, CELLS[i - 1])) <= wanted
                    out.append((cfl, ppc, CELLS[i - 1] if coarser else CELLS[i]))
                    break
        return out

    def clock(self, choice: Choice) -> list[float]:
        """Wall seconds of whole runs."""
        from gsfluent.lab.frozen.answer import clock

        repeat = 3 if self.made[choice][2] < 2.0 else 1
        return clock(self.scene(choice), repeat=repeat, device=self.device, cfl=choice[0])


def ours(options: argparse.Namespace, chosen: Iterable[Setting]) -> int:
    """Find gsfluent's cheapest setting whose error is at most PhysGaussian's."""
    from gsfluent.lab.charts.record import commit, machine

    version, name = commit(), machine(options.device)
    for setting in chosen:
        search = Search(setting, options.device)
        for matter in options.matter:
            found = lines(options.out) + (lines(options.errors) if options.errors else [])
            wanted = target(found, setting, matter)
            case, label = f"demo_{setting.name}", f"at most the error of {matter}"
            if (case, "gsfluent", label, options.device) in map(key, found):
                continue
            if not wanted:
                sys.stdout.write(f"{setting.name}: no error of PhysGaussian's ({matter})\n")
                continue
            # what reached it on another device does so here: the same sums, the same error
            there = [line for line in found if key(line)[:3] == (case, "gsfluent", label)]
            reached = [(c[0], c[1], c[2]) for line in there for c in line["settings"]["reached"]]
            reached = [c for c in reached if search.error(c) <= wanted] or search.reaching(wanted)
            if not reached:
                nearest = min(made[0] for made in search.made.values())
                sys.stdout.write(
                    f"{setting.name} ({matter}): no setting tried reaches {wanted:.4f}; the "
                    f"nearest was {nearest:.4f}\n"
                )
                continue
            timed = [(search.clock(choice), choice) for choice in reached]
            walls, best = min(timed, key=lambda t: float(np.median(t[0])))
            scene = search.scene(best)
            error, steps, _ = search.made[best]
            ride = riding(setting, scene.x, scene.dx, options)
            wall = float(np.median(walls)) / scene.seconds + ride / setting.frame
            add(options.out, record(
                setting, "gsfluent", label, scene, device=options.device, machine=name,
                steps=steps, walls=walls, per_simulated=wall, error=error, commit=version,
                cfl=best[0], ppc=best[1], cells_across=best[2], reached=reached,
                riding_seconds=ride, gaussians=options.gaussians, dtype="float32",
            ))  # fmt: skip
            sys.stderr.write(
                f"{case} {matter}: wanted {wanted:.4f}, got {error:.4f} with {best[2]} cells "
                f"across, cfl {best[0]}, {best[1]} a cell: {wall:.4g} ms/ms\n"
            )
    return 0


def table(found: Sequence[Mapping[str, Any]], device: str) -> str:
    """Markdown of one device."""
    out = [
        "| config | matter | its points | its mass, frequency | its error | its c dt/dx "
        "| as shipped, ms/ms | graph, ms/ms | gsfluent: points, dx over its dx, c dt/dx | error "
        "| ms/ms | cheaper than shipped | than graph |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    by = {key(line): line for line in found}
    errors = {(i["case"], i["variant"]): i["error"] for i in found if i["error"] is not None}
    for case in sorted({line["case"] for line in found}):
        for matter in sorted({str(i["variant"]) for i in found if i["case"] == case}, reverse=True):
            shipped = by.get((case, "physgaussian", matter, device))
            graph = by.get((case, "physgaussian, graph", matter, device))
            mine = by.get((case, "gsfluent", f"at most the error of {matter}", device))
            if shipped is None:
                continue
            error = errors.get((case, matter))
            steps = shipped["settings"]
            pitch = steps.get("frequency_over_exact")
            cells = [case.removeprefix("demo_"), matter, f"{shipped['points']:,}",
                     f"{steps.get('mass_over_exact', 1.0):.2f}"
                     + ("" if pitch is None else f", {pitch:.2f}"),
                     "" if error is None else f"{error:.4f}",
                     f"{steps['courant']:.3f}" if "courant" in steps else "",
                     f"{shipped['wall_per_simulated']:.4g}",
                     f"{graph['wall_per_simulated']:.4g}" if graph else ""]  # fmt: skip
            if mine is None:
                cells += ["no run", "", "", "", ""]
            else:
                own, wall = mine["settings"], mine["wall_per_simulated"]
                cells += [f"{mine['points']:,}, {own['dx'] / steps['dx']:.2f}, {own['cfl']}",
                          f"{mine['error']:.4f}", f"{wall:.4g}",
                          f"{shipped['wall_per_simulated'] / wall:,.0f}",
                          f"{graph['wall_per_simulated'] / wall:,.0f}" if graph else "",
                ]  # fmt: skip
            out.append(f"| {' | '.join(cells)} |")
    return "\n".join(out)


def enter_table(options: argparse.Namespace) -> int:
    """Print the tables of a file, or enter them into a page."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    from gsfluent.figure.markdown import enter

    found = lines(options.out)
    for device in sorted({line["device"] for line in found}):
        machines = sorted({line["machine"] for line in found if line["device"] == device})
        part = f"Machine: {'; '.join(machines)}.\n\n{table(found, device)}"
        if options.markdown is None:
            sys.stdout.write(part + "\n")
            continue
        text = options.markdown.read_text(encoding="utf-8")
        options.markdown.write_text(enter(text, f"demo {device}", part), encoding="utf-8")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("peer", "ours", "table"))
    parser.add_argument("checkout", type=Path, help="PhysGaussian; for table: the records")
    parser.add_argument("-o", "--out", type=Path, help="file of records, added to")
    parser.add_argument("--errors", type=Path, help="more records, for the errors to reach")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--config", action="append", help="only these")
    parser.add_argument("--matter", action="append", choices=MATTER, help="default: both")
    parser.add_argument("--gaussians", type=int, default=demo_scenes.GAUSSIANS)
    parser.add_argument("--steps", type=int, help="timed steps; default 200, on the CPU 3")
    parser.add_argument("--markdown", type=Path, help="enter the tables into this page")
    options = parser.parse_args(arguments)
    if options.what == "table":
        options.out = options.checkout
        return enter_table(options)
    if options.out is None:
        parser.error("give -o")
    other = options.gaussians != demo_scenes.GAUSSIANS
    options.matter = [
        f"{m} of {options.gaussians:,}" if other and m == "pipeline" else m
        for m in options.matter or MATTER
    ]
    known = demo_scenes.settings(options.checkout)
    chosen = [s for s in known if not options.config or s.name in options.config]
    return peer(options, chosen) if options.what == "peer" else ours(options, chosen)


if __name__ == "__main__":
    sys.exit(main())
