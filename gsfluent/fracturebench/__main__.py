"""Command line: ``python -m fracturebench`` with ``PYTHONPATH=gsfluent`` needs only NumPy."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from .registry import cases
from .scene import SceneError
from .score import markdown, plain, read_scenes, score

_ABOUT = """FractureBench: frozen scenes with known answers for simulators of elastic and brittle
bodies, and their scorer. A scene is an .npz of points, velocities, volumes, materials and the times
asked for, with a YAML header beside it; a run is an .npz of positions and velocities at those
times. docs/guide/fracturebench.md reads one and writes the other in ten lines of NumPy."""

_SCORE = """Judge all runs under a folder. Every file RUNS/**/*.npz is one run: arrays times [T],
x [T, N, 3], v [T, N, 3], and header, a JSON text with scene, method, wall_seconds, steps, and
optionally settings, device, failed. Exit status 0: all files judged (whether or not they are within
the tolerance); 1: some file could not be judged; 2: no scenes or no runs."""


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def _list() -> int:
    for c in cases():
        sys.stdout.write(f"{c.name:24} {c.kind:9} dx {c.dx:<8.4g} {c.summary}\n")
    return 0


def _score(args: argparse.Namespace) -> int:
    scenes = read_scenes(args.scenes)
    paths = [args.runs] if args.runs.is_file() else sorted(args.runs.rglob("*.npz"))
    if not paths:
        raise SceneError(f"{args.runs}: no runs (*.npz) in this folder or below it")
    scores = score(scenes, paths)
    good = [s for s in scores if not s.invalid]
    if good:
        sys.stdout.write(markdown(good) + "\n")
    for method in sorted({s.method for s in good}):
        own = [s for s in good if s.method == method]
        missing = sorted(set(scenes) - {s.case for s in own})
        sys.stdout.write(
            f"{method}: {sum(s.passed for s in own)} of {len(own)} within all tolerances"
            + (f"; not answered: {', '.join(missing)}" if missing else "")
            + "\n"
        )
    if args.json is not None:
        _write(args.json, json.dumps(plain(scores), indent=1) + "\n")
    if args.markdown is not None:
        _write(args.markdown, markdown(good) + "\n")
    bad = [s for s in scores if s.invalid]
    for s in bad:
        sys.stderr.write(f"not judged: {s.invalid}\n")
    return 1 if bad else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="fracturebench", description=_ABOUT)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("list", help="name the cases", description="Name the cases.")
    verb = verbs.add_parser("score", help="judge runs", description=_SCORE)
    verb.add_argument("scenes", type=Path, metavar="SCENES", help="folder of scenes, NAME.npz")
    verb.add_argument("runs", type=Path, metavar="RUNS", help="folder of runs, searched for *.npz")
    verb.add_argument("--json", type=Path, metavar="FILE", help="write all measures as JSON")
    verb.add_argument("--markdown", type=Path, metavar="FILE", help="write the table")
    args = parser.parse_args(arguments)
    try:
        return _list() if args.verb == "list" else _score(args)
    except (SceneError, OSError) as error:
        sys.stderr.write(f"fracturebench: {error}\n")
        return 2


if __name__ == "__main__":
    sys.exit(main())
