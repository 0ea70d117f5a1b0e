"""Small shots beside each other on one GPU, against the same shots one after the other.

    python scripts/bench/sweep/packing.py [--device cuda] [--shots 8] [--pack 8] [--json FILE]
    python scripts/bench/sweep/packing.py --shots 64 --gpus 1 2 [--json FILE]     # on so many GPUs
    python scripts/bench/sweep/packing.py --page FILE.json     # enters the table into the docs

A melon is filled and textured once; then the shots, which differ in their seed, go through
gsfluent.sweep twice, one at a time and --pack at a time. Time counts from the first to the last
shot, start of processes included. Films and figures of both are compared. Two minutes on a GPU
with sixteen cores; on a CPU --pack is the number of processes. With --gpus: --pack at a time on
each of so many GPUs, against the first number of them. Enters docs/measured/sweeps.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

import torch
import yaml

import gsfluent as gf
from gsfluent.cli.common import choose_device
from gsfluent.figure.markdown import enter
from gsfluent.hardware import Load, graphics_cards, processor
from gsfluent.io import save_splats
from gsfluent.progress import LineReporter
from gsfluent.sweep import read_sweep, run_sweep
from gsfluent.sweep.folder import SweepFolder

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "sweeps.md"
WARM = 1000
"""Seed of the shot that makes the solids and loads the kernels."""


def sweep_file(folder: Path, seeds: list[int], seconds: float, pack: int, device: str) -> Path:
    """A sweep over seeds."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "melon.ply").is_file():
        save_splats(gf.demo.make_splats("watermelon"), folder / "melon.ply")
    shot = {
        "splats": "melon.ply", "size": 0.25, "objects": {"melon": {"material": "fruit.watermelon"}},
        "texture": {"method": "procedural", "preset": "watermelon"},
        "events": [{"type": "drop", "height": 1.5}], "solve": {"quality": "preview"},
        "output": {"seconds": seconds, "size": [320, 320]},
    }  # fmt: skip
    (folder / "shot.yaml").write_text(yaml.safe_dump(shot))
    each = {"gpu": 1.0 / pack} if device == "cuda" else {}
    sweep = {"shot": "shot.yaml", "vary": {"seed": seeds}, "each": each}
    (folder / "sweep.yaml").write_text(yaml.safe_dump(sweep))
    return folder / "sweep.yaml"


def timed(file: Path, out: Path, device: torch.device, jobs: int) -> dict[str, Any]:
    """How long a sweep takes whose solids are there, and what its processes did meanwhile."""
    start, before = time.time(), Load.now()
    said = run_sweep(
        read_sweep(file, {}, None), out, device=device, jobs=jobs, reporter=LineReporter()
    )
    if not said["ok"] or "failed" in said["verdicts"]:
        raise SystemExit(f"packing.py: {said}")
    return where_time_goes(out, start, before)


def where_time_goes(out: Path, start: float, before: Load) -> dict[str, Any]:
    """Seconds of a sweep that has just ended: start, first and later shots, stages, idle cores."""
    now, end = Load.now(), time.time()
    place = SweepFolder(out)
    names = sorted(place.done())
    rows = sorted(place.rows(names).values(), key=lambda row: float(row["began"]))
    seen: set[int] = set()
    first: list[float] = []
    later: list[float] = []
    for row in rows:
        (later if row["process"] in seen else first).append(float(row["seconds"]))
        seen.add(row["process"])
    stages: dict[str, list[float]] = {}
    for name in names:
        record = json.loads((place.shots / name / "run.json").read_text())
        for stage in record["stages"]:
            stages.setdefault(stage["name"], []).append(float(stage["seconds"]))
    busy = None if now.busy is None or before.busy is None else now.busy - before.busy
    return {
        "wall": end - start,
        "processes": len(seen),
        "until_first": rows[0]["began"] - start,
        "until_all": max(r["began"] for r in rows[: len(seen)]) - start,
        "after_last": end - max(row["began"] + row["seconds"] for row in rows),
        "first_shot": statistics.mean(first),
        "later_shot": statistics.mean(later) if later else None,
        "stages": {name: statistics.mean(found) for name, found in stages.items()},
        "busy_cores": None if busy is None else busy / (now.at - before.at),
    }


def figures(out: Path) -> dict[int, Any]:
    """What came out, by seed."""
    place = SweepFolder(out)
    rows = place.rows(sorted(place.done())).values()
    names = ("frames", "substeps", "particles", "pieces", "dissipated")
    return {
        row["value"]["seed"]: [row["value"]["figures"].get(name) for name in names] for row in rows
    }


def prepare(options: argparse.Namespace, device: torch.device) -> Path:
    """A first shot, whose solids the others share."""
    first: Path = options.out / "warm"
    timed(sweep_file(options.out, [WARM], options.seconds, 1, device.type), first, device, 1)
    return first


def swept(
    options: argparse.Namespace, device: torch.device, first: Path, name: str, pack: int, jobs: int
) -> tuple[dict[str, Any], dict[int, Any]]:
    """How long all shots take, so many at a time, and their figures."""
    out = options.out / name
    shutil.rmtree(out, ignore_errors=True)
    for part in ("stages", "solids"):
        shutil.copytree(first / part, out / part)
    seeds = list(range(options.shots))
    file = sweep_file(options.out, seeds, options.seconds, pack, device.type)
    return timed(file, out, device, jobs), figures(out)


def spread(options: argparse.Namespace) -> list[dict[str, Any]]:
    """The same shots on each number of GPUs."""
    device, cards = choose_device("cuda"), graphics_cards()
    first, rows = prepare(options, device), []
    wanted: dict[int, Any] = {}
    for count in options.gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(cards[:count])  # for the processes
        jobs = options.pack * count
        times, found = swept(options, device, first, f"gpus_{count}", options.pack, jobs)
        wanted = wanted or found
        rows.append({
            "device": torch.cuda.get_device_name(device), "cores": os.cpu_count(), "gpus": count,
            "shots": options.shots, "pack": options.pack, "same_figures": found == wanted,
            **times,
        })  # fmt: skip
    return rows


def spread_table(rows: list[dict[str, Any]]) -> str:
    """A table of several GPUs for each machine."""
    rows = sorted(rows, key=lambda row: (int(row["cores"]), int(row["gpus"])))
    machines = itertools.groupby(rows, key=lambda row: (row["device"], row["cores"]))
    return "\n\n".join(_of_machine(list(of_one)) for _, of_one in machines)


def _of_machine(rows: list[dict[str, Any]]) -> str:
    one = rows[0]
    lines = [
        f"{one['shots']} drops of a melon on {one['device']} with {one['cores']} cores, "
        f"{one['pack']} at a time on each GPU:",
        "",
        "| GPUs | wall [s] | a shot [s] | times the first | until all processes work [s] | "
        "first shot of a process [s] | later ones [s] | after the last [s] | busy cores | "
        "figures of the first |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {r['gpus']} | {r['wall']:.1f} | {r['wall'] / r['shots']:.2f} | "
        f"{one['wall'] / r['wall']:.2f} | {r['until_all']:.1f} | {r['first_shot']:.1f} | "
        f"{_seconds(r['later_shot'])} | {r['after_last']:.1f} | {_seconds(r['busy_cores'])} | "
        f"{'yes' if r['same_figures'] else 'no'} |"
        for r in rows
    ]
    return "\n".join(lines)


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Both sweeps."""
    device = choose_device(options.device)
    times, found = {}, {}
    first = prepare(options, device)
    for pack in (options.pack, 1):
        times[pack], found[pack] = swept(options, device, first, f"pack_{pack}", pack, pack)
    alone = SweepFolder(options.out / "pack_1")
    peaks = [
        row["value"]["figures"]["peak_device_memory_bytes"]
        for row in alone.rows(sorted(alone.done())).values()
    ]
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor()
    return {
        "device": name, "cores": os.cpu_count(), "shots": options.shots, "pack": options.pack,
        "points": found[1][0][2], "seconds_of_film": options.seconds,
        "one_after_another": times[1], "packed": times[options.pack],
        "peak_device_memory_bytes": max(peaks), "same_figures": found[1] == found[options.pack],
    }  # fmt: skip


def markdown(row: dict[str, Any]) -> str:
    """The table."""
    alone, packed = row["one_after_another"], row["packed"]
    return "\n".join([
        f"{row['shots']} drops of a melon ({row['points']:,} points, {row['seconds_of_film']:g} s) "
        f"on {row['device']} with {row['cores']} cores:",
        "",
        "| | wall [s] | a shot [s] | until all processes work [s] | first shot of a process [s] | "
        "later ones [s] | after the last [s] | busy cores |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
        *(
            f"| {name} | {t['wall']:.1f} | {t['wall'] / row['shots']:.1f} | {t['until_all']:.1f} | "
            f"{t['first_shot']:.1f} | {_seconds(t['later_shot'])} | {t['after_last']:.1f} | "
            f"{_seconds(t['busy_cores'])} |"
            for name, t in (("one after another", alone), (f"{row['pack']} at a time", packed))
        ),
        "",
        f"{alone['wall'] / packed['wall']:.2f} times as fast; a shot's tensors take "
        f"{row['peak_device_memory_bytes'] / 1e9:.2g} GB of the GPU; figures of both are "
        f"{'the same' if row['same_figures'] else 'not the same'}.",
    ])  # fmt: skip


def table(row: Any) -> str:
    """The table of what was measured."""
    return spread_table(row) if isinstance(row, list) else markdown(row)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--shots", type=int, default=8)
    parser.add_argument("--pack", type=int, default=8, help="shots at a time")
    parser.add_argument("--seconds", type=float, default=0.6, help="of film")
    parser.add_argument("-o", "--out", type=Path, default=Path("packing"))
    parser.add_argument("--json", type=Path, help="where the figures go")
    parser.add_argument("--gpus", type=int, nargs="*", help="numbers of GPUs to spread shots over")
    parser.add_argument("--page", type=Path, nargs="+", metavar="FILE.json", help="only enter")
    options = parser.parse_args()
    if options.page is not None:
        found = [json.loads(path.read_text()) for path in options.page]
        row = [r for rows in found for r in rows] if isinstance(found[0], list) else found[0]
        part = "spread" if isinstance(row, list) else "packing"
        heading = "## On several GPUs" if part == "spread" else "## Packed"
        PAGE.write_text(enter(PAGE.read_text(), part, table(row), heading))
        return
    if options.gpus:
        there = len(graphics_cards())
        if not 1 <= min(options.gpus) <= max(options.gpus) <= there:
            parser.error(f"--gpus: this machine has {there}, got {options.gpus}")
    row = spread(options) if options.gpus else measure(options)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(row, indent=1) + "\n")
    print(table(row))


if __name__ == "__main__":
    main()
