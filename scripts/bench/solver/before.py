"""Time the solver of this checkout beside an earlier one, in turn on one machine.

git worktree add build/before COMMIT       # and build it there: python setup.py build_ext --inplace
python scripts/bench/solver/before.py build/before --most 1.02

Both run scripts/bench/mpm.py of this checkout, each time in a process of its own, one after the
other, and again: what the machine does meanwhile falls on both. A row's figure is the median over
the repeats of the ratio of two neighbours. Ends with 1 when one is above --most.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[3]


def rows_of(checkout: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """What the benchmark measures with the package of a checkout."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "rows.json"
        command = [
            sys.executable, HERE / "scripts/bench/mpm.py", "--rows", *options.rows,
            "--kinds", *options.kinds, "--orders", "random", "--device", options.device,
            "--json", out,
        ]  # fmt: skip
        done = subprocess.run(
            [str(part) for part in command], check=False, capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(checkout)},
        )  # fmt: skip
        if done.returncode != 0:
            sys.exit(f"before: the benchmark failed with {checkout}:\n{done.stderr}")
        rows: list[dict[str, Any]] = json.loads(out.read_text())["rows"]
        return rows


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path, help="checkout to compare with, built")
    parser.add_argument("--rows", nargs="*", default=["200:50", "200:80", "300:100"])
    parser.add_argument("--kinds", nargs="*", default=["elastic", "nacc", "two"])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--most", type=float, default=1.02)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if not (options.before / "gsfluent").is_dir():
        parser.error(f"{options.before}: no checkout of gsfluent; git worktree add makes one")
    times: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for _ in range(options.repeats):
        old = rows_of(options.before.resolve(), options)
        for a, b in zip(old, rows_of(HERE, options), strict=True):
            times.setdefault((b["kind"], b["particles"]), []).append((a["ms"], b["ms"]))
    worst, rows = 0.0, []
    print("| scene | points | before, ms | now, ms | now / before |")
    print("| --- | --- | --- | --- | --- |")
    for (kind, points), pairs in times.items():
        before, now = (statistics.median(side) for side in zip(*pairs, strict=True))
        ratio = statistics.median(b / a for a, b in pairs)
        worst = max(worst, ratio)
        rows.append({"kind": kind, "particles": points, "pairs": pairs, "ratio": ratio})
        print(f"| {kind} | {points:,} | {before:.4f} | {now:.4f} | {ratio:.3f} |")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return int(worst > options.most)


if __name__ == "__main__":
    sys.exit(main())
