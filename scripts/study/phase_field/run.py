"""The long tests of the phase-field law, measured and entered into docs/measured/phase_field.md.

    python scripts/study/phase_field/run.py OUT [--processes 8] [--only NAME,...] [--quick]
        [--device cuda]
    python scripts/study/phase_field/run.py OUT --enter

Each job is a process of its own with OMP_NUM_THREADS threads and leaves NAME.json and NAME.npz in
OUT; what is there is not run again. All jobs take about four hours of one core; on a GPU they take
minutes. --only takes how names of jobs begin. --enter writes into the page and its pictures what
OUT holds; rows that OUT has not stay.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
import tables
import torch
from cases import Job, jobs

from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.record import machine

PAGE = tables.ROOT / "docs" / "measured" / "phase_field.md"


def work(job: Job, out: Path, device: str) -> None:
    """Run a job and write its files."""
    begin, spent = time.perf_counter(), time.process_time()
    found, scene, run = job.work()
    if scene is not None and run is not None:
        found |= {"points": scene.count, "steps": run.steps, "dx": scene.dx}
    found |= {
        "test": job.test, "setting": job.setting, "wall": time.perf_counter() - begin,
        "cpu": time.process_time() - spent,
        "threads": torch.get_num_threads(), "machine": machine(device),
    }  # fmt: skip
    if scene is not None and run is not None and run.damage is not None:
        with atomic_path(out / f"{job.name}.npz") as path, path.open("wb") as file:
            np.savez_compressed(
                file, x=scene.x[:, :2].astype(np.float32),
                damage=(255.0 * run.damage[-1]).astype(np.uint8), dx=scene.dx,
            )  # fmt: skip
    with atomic_path(out / f"{job.name}.json") as path:
        path.write_text(json.dumps(found), encoding="utf-8")


def in_parallel(chosen: list[Job], args: argparse.Namespace) -> int:
    """Run jobs in processes, long ones first; returns how many failed."""
    begin, bad = time.perf_counter(), 0
    waiting = sorted(chosen, key=lambda job: job.seconds)
    running: dict[str, subprocess.Popen[bytes]] = {}
    while waiting or running:
        while waiting and len(running) < args.processes:
            job = waiting.pop()
            command = [sys.executable, __file__, str(args.out), "--job", job.name]
            command += ["--device", args.device]
            command += ["--quick"] if args.quick else []
            running[job.name] = subprocess.Popen(command, env=os.environ)
        time.sleep(0.05)
        for name in [n for n, p in running.items() if p.poll() is not None]:
            code = running.pop(name).returncode
            bad += code != 0
            sys.stderr.write(f"{name}: {'done' if code == 0 else f'failed ({code})'} ")
            sys.stderr.write(f"[{time.perf_counter() - begin:.0f} s, {len(waiting)} wait]\n")
    return bad


def records(out: Path) -> dict[str, dict[str, Any]]:
    """What the jobs found, by name."""
    return {p.stem: json.loads(p.read_text(encoding="utf-8")) for p in sorted(out.glob("*.json"))}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--processes", type=int, default=1, metavar="N")
    parser.add_argument("--only", default="", metavar="NAME,...", help="begins of names of jobs")
    parser.add_argument("--quick", action="store_true", help="one small run of each test")
    parser.add_argument("--enter", action="store_true", help="write the page")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--job", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.enter:
        tables.enter_page(records(args.out), args.out, PAGE)
        return 0
    known = jobs(args.quick, args.device)
    if args.job:
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
        work(next(job for job in known if job.name == args.job), args.out, args.device)
        return 0
    only = tuple(filter(None, args.only.split(",")))
    if wrong := [o for o in only if not any(job.name.startswith(o) for job in known)]:
        sys.stderr.write(f"run.py: no job {', '.join(wrong)}\n")
        return 2
    chosen = [
        job
        for job in known
        if job.name.startswith(only or "") and not (args.out / f"{job.name}.json").is_file()
    ]
    return 1 if in_parallel(chosen, args) else 0


if __name__ == "__main__":
    sys.exit(main())
