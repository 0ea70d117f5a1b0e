"""gsfluent's answers to all scenes of FractureBench, as files that the scorer reads.

    python scripts/fracturebench/run_gsfluent.py -o RUNS [--device cuda] [NAME ...]

One run with stops at the times asked for gives positions and velocities; the time is the median of
--repeat runs straight to the end. What is there is not run again. On two cores all cases take
about three minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import frozen
import torch

from gsfluent.errors import InputError
from gsfluent.fracturebench.registry import cases, find, judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import SceneError
from gsfluent.lab.charts.record import commit, machine
from gsfluent.lab.frozen.answer import clock, run_case

METHODS = {"nacc": "gsfluent", "phase_field": "gsfluent phase field"}
"""Names of gsfluent's laws of breaking in the table."""
QUICK = ("bar", "two_material_bar", "pull_apart", "covariance_transport", "oblique")


def answer(name: str, args: argparse.Namespace, path: Path) -> Run:
    """Run a case and write its file."""
    case = find(name)
    scene = frozen.build(case)
    if drift := frozen.drift(case, scene):
        raise SceneError(f"{name}: not what was frozen: {drift[0]}")
    options: dict[str, Any] = {
        "device": args.device, "dtype": getattr(torch, args.dtype), "cfl": args.cfl,
        "fields": not args.one_field, "place": args.place, "law": args.law,
    }  # fmt: skip
    run = run_case(scene, method=args.method, **options)
    wall = run.wall_seconds
    if not run.failed:
        wall = statistics.median(clock(scene, args.repeat, **options))
    settings = {
        **run.settings, "timing": "uninterrupted", "repeat": args.repeat,
        "machine": machine(args.device), "commit": commit(), "sha256": scene.digest(),
    }  # fmt: skip
    run = dataclasses.replace(run, wall_seconds=wall, settings=settings)
    run.save(path)
    return run


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; default all")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="RUNS")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    parser.add_argument("--cfl", type=float, default=0.5, help="Courant number")
    parser.add_argument(
        "--place", type=float, default=0.0, metavar="DX",
        help="move the points on the grid by this, along the axes without a collider",
    )  # fmt: skip
    parser.add_argument("--one-field", action="store_true", help="all bodies in one velocity field")
    parser.add_argument(
        "--law", choices=("nacc", "phase_field"), default="nacc", help="of what breaks"
    )
    parser.add_argument("--method", default="", help="name in the table")
    parser.add_argument("--repeat", type=int, default=3, help="timed runs")
    parser.add_argument("--quick", action="store_true", help="a few small cases, once each")
    args = parser.parse_args()
    if args.quick:
        args.repeat = 1
    args.method = args.method or METHODS[args.law]
    bad = 0
    try:
        kind = None if args.law == "nacc" else "fracture"
        names = args.names or ([*QUICK] if args.quick else [c.name for c in cases(kind)])
        for name in names:
            find(name)
        folder = args.out / args.method.replace(" ", "_").replace(",", "")
        begin = time.perf_counter()
        for i, name in enumerate(names, 1):
            path = folder / f"{name}.npz"
            if path.is_file():
                was = Run.load(path)
                now = {"dtype": args.dtype, "cfl": args.cfl, "place": args.place, "law": args.law}
                had = {"place": 0.0, "law": "nacc", **was.settings}
                if was.device != args.device or any(had.get(k) != now[k] for k in now):
                    raise SceneError(
                        f"{path} was computed on {was.device} with {dict(was.settings)}: give "
                        "another -o or --method, or remove it"
                    )
                if was.settings.get("sha256") == frozen.build(find(name)).digest():
                    sys.stderr.write(f"{i}/{len(names)} {name}: {path} is there\n")
                    continue
            try:
                run = answer(name, args, path)
            except (SceneError, NotImplementedError, RuntimeError) as error:
                bad += 1
                sys.stderr.write(f"{i}/{len(names)} {name}: not run: {error}\n")
                continue
            first = judge(frozen.build(find(name)), run)[0]
            sys.stderr.write(
                f"{i}/{len(names)} {name}: error {first.error:.3g} of {first.tolerance:g} allowed, "
                f"{run.wall_seconds:.3g} s, {run.steps} steps {run.failed} "
                f"[{time.perf_counter() - begin:.0f} s]\n"
            )
    except (SceneError, InputError, ValueError, OSError) as error:
        sys.stderr.write(f"run_gsfluent.py: {error}\n")
        return 2
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
