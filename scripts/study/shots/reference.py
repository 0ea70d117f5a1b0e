"""Costs of a reference machine, for the first plan on any other: ``gsfluent/plan/reference*.json``.

python scripts/study/shots/reference.py                   # a minute
python scripts/study/shots/reference.py --device cuda

On a CPU one thread works, and its CPU seconds are taken for the time: others may be at work.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

from gsfluent.hardware import processor
from gsfluent.io import write_json
from gsfluent.plan.probe import calibrate
from gsfluent.plan.quick import REFERENCE, pieces


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", choices=sorted(REFERENCE), default="cpu")
    parser.add_argument("-o", "--output", type=Path, default=None)
    options = parser.parse_args(arguments)
    if options.device == "cpu":
        time.perf_counter = time.process_time  # what every stage asks for its time
    model = calibrate(options.device)
    found = pieces(options.device)
    where = model.machine.get("gpu", processor())
    write_json(options.output or REFERENCE[options.device], {
        "processor": where, "threads": model.machine["threads"], "made": model.made,
        "pieces": found, "seconds": model.seconds, "errors": model.errors,
    })  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
