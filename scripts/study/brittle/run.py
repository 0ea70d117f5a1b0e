"""What kills brittle MPM on GPUs: the discontinuity, the order of sums, or a division by zero?

python scripts/study/brittle/run.py -o brittle.jsonl --markdown docs/measured/brittle_gpu.md \
    --figure docs/images/brittle_gpu.png
python scripts/study/brittle/run.py -o brittle_gpu.jsonl --device cuda --parts order debris ejecta
python scripts/study/brittle/run.py -o brittle.jsonl brittle_gpu.jsonl --only-tables \
    --markdown docs/measured/brittle_gpu.md

One JSON line per run; what is in the file is not run again. Tables and the figure are drawn from
the files.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import torch
from cases import PARTS, Job, jobs, perform
from tables import draw, tables

from gsfluent.figure.markdown import enter
from gsfluent.progress import reporter


def records(paths: list[Path]) -> list[dict[str, Any]]:
    """All lines of the files that exist."""
    found = []
    for path in paths:
        if path.exists():
            lines = path.read_text(encoding="utf-8").splitlines()
            found += [json.loads(line) for line in lines if line.strip()]
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "-o", "--output", type=Path, nargs="+", required=True,
        help="JSON lines; runs are added to the first file, all are read",
    )  # fmt: skip
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="a subset, half a minute")
    parser.add_argument("--only-tables", action="store_true", help="run nothing")
    parser.add_argument("--markdown", type=Path, help="enter the tables into this page")
    parser.add_argument("--figure", type=Path, help="draw the figure")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("no CUDA device here")
    torch.set_num_threads(1)
    if not options.only_tables:
        done = {(Job.of(r).key, r["device"]) for r in records(options.output)}
        todo = [
            job
            for job in jobs(options.parts, options.device, options.quick)
            if (job.key, options.device) not in done
        ]
        options.output[0].parent.mkdir(parents=True, exist_ok=True)
        with reporter() as bars:
            report = bars.task("brittle")
            for i, job in enumerate(todo):
                report(i, len(todo), f"{job.part} {job.scene}")
                line = json.dumps(perform(job, options.device))
                with options.output[0].open("a", encoding="utf-8") as file:
                    file.write(line + "\n")
            report(len(todo), len(todo), "")
    found = records(options.output)
    for name, part in tables(found).items():
        sys.stdout.write(part + "\n\n")
        if options.markdown:
            page = options.markdown
            page.write_text(enter(page.read_text() if page.exists() else "", name, part))
    if options.figure:
        draw(found, options.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
