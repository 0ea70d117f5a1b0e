"""What the stages of whole shots cost, and how much more than its solver the simulation takes.

python scripts/stages/shots.py examples/*.yaml -o out/shots --json shots.json
python scripts/stages/shots.py examples/watermelon_dropped.yaml --markdown docs/measured/shots.md

Every shot is run anew by the command line in a process of its own; its run.json says what each
stage took. The overhead ratio is the simulate stage over what the steps alone would take: substeps
times points times the nanoseconds of a point's step, which scripts/bench/mpm.py measures first on
the same machine (NACC; a million points on a GPU, 110 592 on a CPU with all its threads). Points
that fly or sleep take no step but are counted, so 1 is no lower bound.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from gsfluent import has_cuda
from gsfluent.figure.markdown import enter

BENCH = Path(__file__).resolve().parents[1] / "bench" / "mpm.py"


def ns_per_point_step(device: str) -> float:
    """Of a whole step of the resident solver on this machine [ns]."""
    row = "200:50" if device == "cuda" else "100:24"
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "mpm.json"
        command = [sys.executable, str(BENCH), "--device", device, "--rows", row]
        command += ["--kinds", "nacc", "--orders", "lattice", "--json", str(found)]
        command += ["--threads", str(torch.get_num_threads())]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return float(json.loads(found.read_text())["rows"][0]["ns_per_particle"])


def run(shot: Path, out: Path, device: str) -> dict[str, Any]:
    """Run a shot from nothing; what its run.json says."""
    command = [sys.executable, "-m", "gsfluent", "run", str(shot), "-o", str(out)]
    subprocess.run([*command, "--device", device, "--force"], check=True)
    return dict(json.loads((out / "run.json").read_text()))


def overhead_ratio(values: dict[str, Any], nanoseconds: float) -> float:
    """Simulate stage over its steps alone."""
    moved = values["simulation"]
    alone = moved["substeps"] * moved["particles"] * nanoseconds * 1e-9
    return float(next(s["seconds"] for s in values["stages"] if s["name"] == "simulate") / alone)


def row_of(name: str, values: dict[str, Any], nanoseconds: float) -> dict[str, Any]:
    """One shot's figures."""
    stages = {stage["name"]: stage for stage in values["stages"]}
    return {
        "shot": name,
        "points": values["simulation"]["particles"],
        "substeps": values["simulation"]["substeps"],
        "stages": {
            key: {part: stage.get(part) for part in ("seconds", "cpu_seconds")}
            for key, stage in stages.items()
        },
        "peak_memory_bytes": max(s.get("peak_memory_bytes") or 0 for s in stages.values()),
        "peak_device_memory_bytes": max(
            s.get("peak_device_memory_bytes") or 0 for s in stages.values()
        ),
        "overhead_ratio": overhead_ratio(values, nanoseconds),
    }


def markdown(rows: list[dict[str, Any]], device: str, nanoseconds: float) -> str:
    """The table: wall seconds (CPU seconds) by stage."""
    names = list(dict.fromkeys(name for row in rows for name in row["stages"]))
    what = torch.cuda.get_device_name() if device == "cuda" else "CPU"
    lines = [
        f"Device: {what}, {torch.get_num_threads()} threads; a point's step takes "
        f"{nanoseconds:.3g} ns. Wall seconds of each stage, CPU seconds in brackets.",
        "",
        f"| shot | points | steps | {' | '.join(names)} | overhead ratio |",
        "| --- " * (4 + len(names)) + "|",
    ]
    for row in rows:
        cells = []
        for name in names:
            stage = row["stages"].get(name)
            cells.append(f"{stage['seconds']:.1f} ({stage['cpu_seconds']:.1f})" if stage else "")
        lines.append(
            f"| {row['shot']} | {row['points']:,} | {row['substeps']:,} | {' | '.join(cells)} | "
            f"{row['overhead_ratio']:.1f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shots", nargs="+", type=Path, help="shot files")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/shots"))
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--label", default="", help="what the table is of, such as: before")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    device = options.device
    if device == "auto":
        device = "cuda" if has_cuda() else "cpu"
    nanoseconds = ns_per_point_step(device)
    rows = []
    for shot in options.shots:
        rows.append(row_of(shot.stem, run(shot, options.out / shot.stem, device), nanoseconds))
        sys.stderr.write(f"{shot.stem}: overhead ratio {rows[-1]['overhead_ratio']:.1f}\n")
    if options.json:
        found = {"device": device, "ns_per_point_step": nanoseconds, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    table = markdown(rows, device, nanoseconds)
    if options.markdown:
        page = options.markdown
        old = page.read_text() if page.exists() else "# What whole shots cost\n"
        page.write_text(enter(old, f"shots {device} {options.label}".rstrip(), table.rstrip()))
    sys.stdout.write(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
