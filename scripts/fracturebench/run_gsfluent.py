"""gsfluent's answers to all scenes of FractureBench, as files that the scorer reads.

    python scripts/fracturebench/run_gsfluent.py -o RUNS [--device cuda] [NAME ...]

One run with stops at the times asked for gives positions and velocities; the time is the median of
--repeat runs straight to the end. What is there is not run again. On two cores all cases take
about three minutes. --jobs and --on run several at a time, here or on a cluster; the times of
several on one machine are not those of one alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import frozen

from gsfluent.errors import InputError
from gsfluent.fracturebench.registry import cases, find, judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import SceneError
from gsfluent.lab.charts.run_case import ANSWER, Question, answer_task
from gsfluent.sweep.engine import map as sweep_map

METHODS = {
    "named": "gsfluent", "nacc": "gsfluent nacc", "rankine": "gsfluent rankine",
    "phase_field": "gsfluent phase field",
}  # fmt: skip
"""Names of gsfluent's laws of breaking in the table."""
QUICK = ("bar", "two_material_bar", "pull_apart", "covariance_transport", "oblique")


def question(name: str, args: argparse.Namespace) -> Question:
    """A case as it is to be answered.

    Raises:
        SceneError: Its scene is not what was frozen.
    """
    case = find(name)
    scene = frozen.build(case)
    if drift := frozen.drift(case, scene):
        raise SceneError(f"{name}: not what was frozen: {drift[0]}")
    return Question(
        name, frozen.PER_CELL, scene.digest(), args.device, args.dtype, args.cfl, args.place,
        not args.one_field, args.method, args.repeat, args.law, args.contact,
    )  # fmt: skip


def answers(questions: Sequence[Question], args: argparse.Namespace, folder: Path) -> Iterator[str]:
    """Answer questions one after the other, or as tasks of a sweep; says why one was not."""
    if args.jobs == 1 and args.on == "local":
        for asked in questions:
            try:
                with tempfile.TemporaryDirectory(dir=folder, prefix=".") as place:
                    answer_task(asked, Path(place))
                    Path(place, ANSWER).replace(folder / f"{asked.case}.npz")
                yield ""
            except (SceneError, NotImplementedError, RuntimeError) as error:
                yield str(error)
        return
    tasks = folder / "tasks"
    threads = max((os.cpu_count() or 1) // max(args.jobs, 1), 1) if args.on == "local" else 1
    outcomes = sweep_map(
        answer_task, questions, tasks, jobs=args.jobs, threads=threads, on=args.on, retry=True
    )
    for asked, outcome in zip(questions, outcomes, strict=True):
        if outcome.folder is not None:
            (outcome.folder / ANSWER).replace(folder / f"{asked.case}.npz")
        yield str((outcome.failure or {}).get("message", ""))
    shutil.rmtree(tasks)


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
        "--law", choices=tuple(METHODS), default="named",
        help="of what breaks; by default the phase field where matter names the width of its "
        "cracks, NACC elsewhere",
    )  # fmt: skip
    parser.add_argument(
        "--contact", choices=("points", "nodes"), default="points",
        help="what separating colliders and other bodies push",
    )  # fmt: skip
    parser.add_argument("--method", default="", help="name in the table")
    parser.add_argument("--repeat", type=int, default=3, help="timed runs")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--on", default="local", help="local, slurm, ray or ray=HOST:PORT")
    parser.add_argument("--quick", action="store_true", help="a few small cases, once each")
    args = parser.parse_args()
    if args.quick:
        args.repeat = 1
    pushed = " nodes" if args.contact == "nodes" else ""
    args.method = args.method or METHODS[args.law] + pushed
    bad = 0
    try:
        kind = None if args.law == "named" else "fracture"
        names = args.names or ([*QUICK] if args.quick else [c.name for c in cases(kind)])
        for name in names:
            find(name)
        folder = args.out / args.method.replace(" ", "_").replace(",", "")
        folder.mkdir(parents=True, exist_ok=True)
        begin = time.perf_counter()
        asked: list[Question] = []
        for name in names:
            path = folder / f"{name}.npz"
            if path.is_file():
                was = Run.load(path)
                now = {
                    "dtype": args.dtype, "cfl": args.cfl, "place": args.place, "law": args.law,
                    "contact": args.contact,
                }  # fmt: skip
                had = {"place": 0.0, "law": "nacc", "contact": "nodes", **was.settings}
                if was.device != args.device or any(had.get(k) != now[k] for k in now):
                    raise SceneError(
                        f"{path} was computed on {was.device} with {dict(was.settings)}: give "
                        "another -o or --method, or remove it"
                    )
                if was.settings.get("sha256") == frozen.build(find(name)).digest():
                    sys.stderr.write(f"{name}: {path} is there\n")
                    continue
            try:
                asked.append(question(name, args))
            except SceneError as error:
                bad += 1
                sys.stderr.write(f"{name}: not run: {error}\n")
        for i, wrong in enumerate(answers(asked, args, folder)):
            name = asked[i].case
            if wrong:
                bad += 1
                sys.stderr.write(f"{i + 1}/{len(asked)} {name}: not run: {wrong}\n")
                continue
            run = Run.load(folder / f"{name}.npz")
            first = judge(frozen.build(find(name)), run)[0]
            sys.stderr.write(
                f"{i + 1}/{len(asked)} {name}: error {first.error:.3g} of {first.tolerance:g} "
                f"allowed, {run.wall_seconds:.3g} s, {run.steps} steps {run.failed} "
                f"[{time.perf_counter() - begin:.0f} s]\n"
            )
    except (SceneError, InputError, ValueError, OSError) as error:
        sys.stderr.write(f"run_gsfluent.py: {error}\n")
        return 2
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
