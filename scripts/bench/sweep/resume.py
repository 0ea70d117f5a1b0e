"""What a sweep costs that is taken up again when all of it is done.

    python scripts/bench/sweep/resume.py [--shots 10000] [--json FILE] [--page]

Shots are put among the finished without being run, each with a row as one that ran; then
`gsfluent sweep` is called twice, as somebody does who wants the rest of a sweep. The second call
finds the list of shots that the first one made. Time is that of the processor, start of Python and
imports included. --page enters the table into docs/measured/sweeps.md.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
import yaml

from gsfluent.data import SURFACE, Gaussians
from gsfluent.figure.markdown import enter
from gsfluent.hardware import processor
from gsfluent.io import save_splats
from gsfluent.sweep import read_sweep
from gsfluent.sweep.folder import ROW, SweepFolder
from gsfluent.sweep.tasks import tasks_of

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "sweeps.md"
FIGURES = ("frames", "substeps", "particles", "pieces", "fragments", "kinetic", "dissipated")


def sweep_file(folder: Path, shots: int) -> Path:
    """A sweep of so many seeds and heights of a few splats."""
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    splats = Gaussians.from_colors(points, torch.full((40,), 0.1), points, label=SURFACE)
    save_splats(splats, folder / "ball.ply")
    shot = {"splats": "ball.ply", "events": [{"type": "drop", "height": 1.0}], "size": 0.2}
    (folder / "shot.yaml").write_text(yaml.safe_dump(shot))
    vary = {"events.drop.height": {"uniform": [0.5, 2.0]}, "seed": {"range": [0, shots]}}
    sweep = {"shot": "shot.yaml", "vary": vary, "sample": "sobol", "count": shots}
    (folder / "sweep.yaml").write_text(yaml.safe_dump(sweep))
    return folder / "sweep.yaml"


def finish(file: Path, out: Path) -> int:
    """Put all shots among the finished; returns how many there are."""
    place = SweepFolder(out)
    place.make()
    tasks = tasks_of(read_sweep(file, {}, None), out, device="cpu", seed=0)
    (out / "tasks.json").unlink()  # the first call makes it
    for task in tasks:
        value = {
            "index": task.index, "seed": task.seed, "object": task.object, "changes": task.changes,
            "verdict": "clean", "reason": "", "figures": dict.fromkeys(FIGURES, 1.5),
        }  # fmt: skip
        (place.shots / task.id).mkdir()
        row = {"id": task.id, "value": value, "tries": 1, "host": "here", "seconds": 1.0}
        (place.shots / task.id / ROW).write_text(json.dumps(row))
    return len(tasks)


def resumed(file: Path, out: Path) -> dict[str, float]:
    """Seconds of a call of the verb."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "gsfluent", "sweep", str(file), "-o", str(out)]
    done = subprocess.run(
        [*command, "--device", "cpu", "--json"], check=True, capture_output=True, text=True
    )
    said = json.loads(done.stdout)
    assert said["ok"] and said["verdicts"] == {"clean": said["shots"]}
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_seconds": cpu, "wall_seconds": time.perf_counter() - start}


def markdown(row: dict[str, Any]) -> str:
    """The table."""
    lines = [f"{row['shots']:,} shots that are done, one thread of {row['machine']}:", ""]
    lines += ["| call | CPU [s] | wall [s] |", "| --- | --- | --- |"]
    for name, words in (("first", "looks all shots through"), ("again", "finds their list")):
        found = row[name]
        lines.append(f"| {words} | {found['cpu_seconds']:.1f} | {found['wall_seconds']:.1f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shots", type=int, default=10_000)
    parser.add_argument("--json", type=Path, help="where the figures go")
    parser.add_argument("--page", action="store_true", help="enter the table into the docs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        file = sweep_file(place, options.shots)
        row: dict[str, Any] = {"shots": finish(file, place / "out"), "machine": processor()}
        row["first"], row["again"] = resumed(file, place / "out"), resumed(file, place / "out")
    if options.json is not None:
        options.json.write_text(json.dumps(row, indent=1) + "\n")
    if options.page:
        PAGE.write_text(enter(PAGE.read_text(), "resume", markdown(row)))
    print(markdown(row))


if __name__ == "__main__":
    main()
