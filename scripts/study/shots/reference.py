"""Costs of a reference machine, for the first plan on any other: ``gsfluent/plan/reference*.json``.

python scripts/study/shots/reference.py                   # a minute
python scripts/study/shots/reference.py --device cuda
python scripts/study/shots/reference.py --device cuda --runs demo/run.json melon/run.json

The last teaches the costs that there are by finished runs on that machine, quiet ones: the probe's
small shots on a GPU are bound by launches, and say little of what grows.

On a CPU one thread works, and its CPU seconds are taken for the time: others may be at work.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from gsfluent.hardware import processor
from gsfluent.io import write_json
from gsfluent.plan.fact import actual_work
from gsfluent.plan.probe import calibrate
from gsfluent.plan.quick import REFERENCE, pieces

BELIEVED = 0.03
"""Weight of the costs that were known beside those of a run, squared; in shares of its time."""
MORE = {"simulate": ("frame_points",)}
"""What else a stage's time grows with in large shots."""


def work_of(values: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Work of the stages of a run of photographs and exemplars that broke something."""
    images = float(values["reconstruction"]["images"])
    steps, side = values["reconstruction"]["iterations"], values["reconstruction"]["image_size"]
    width, height = values["shot"]["output"]["size"]
    objects = float(len(values["shot"]["objects"]))
    planned: dict[str, dict[str, float]] = {
        "reconstruct": {"start": 1.0, "images": images, "steps": steps,
                        "step_pixels": steps * side**2, "step_splats": 0.0},
        "isolate": {"start": 1.0, "splats": 0.0},
        "fill": {"start": 1.0, "images": images, "splats": 0.0},
        "texture": {"start": 1.0, "exemplar_objects": objects, "exemplar_voxels": 0.0},
        "simulate": {"start": 1.0, "point_steps_nacc": 0.0, "gaussians": 0.0,
                     "cracked_gaussians": 1.0},
        "render": {"start": 1.0, "pixels": width * height, "gaussians": 0.0},
    }  # fmt: skip
    return actual_work(planned, values)


def taught(seconds: dict[str, dict[str, float]], runs: list[Path]) -> None:
    """Change costs by what runs took, as little as their times allow."""
    from scipy.optimize import nnls

    found = [json.loads(path.read_text(encoding="utf-8")) for path in runs]
    for stage in ("reconstruct", "fill", "texture", "simulate", "render"):
        known = seconds[stage] | dict.fromkeys(MORE.get(stage, ()), 0.0)
        rows = []
        for values in found:
            took = {one["name"]: one["seconds"] for one in values["stages"]}[stage]
            rows.append([work_of(values)[stage].get(name, 0.0) / took for name in known])
        table, before = np.array(rows), np.array(list(known.values()))
        share = table.max(axis=0)
        used = share > 0.0
        # a known cost may go down to nothing at the price of its share; each counts by that
        weight = BELIEVED**0.5 * np.diag(share[used])
        costs, _ = nnls(
            np.vstack([table[:, used], weight]),
            np.concatenate([np.ones(len(rows)), weight @ before[used]]),
        )
        seconds[stage] = known | dict(
            zip([n for n, u in zip(known, used, strict=True) if u], costs.tolist(), strict=True)
        )
        said = ", ".join(f"{value:.2f}" for value in table[:, used] @ costs)
        sys.stdout.write(f"{stage}: plan over fact {said}\n")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", choices=sorted(REFERENCE), default="cpu")
    parser.add_argument("-o", "--output", type=Path, default=None)
    parser.add_argument("--runs", nargs="+", type=Path, metavar="RUN.JSON")
    options = parser.parse_args(arguments)
    if options.runs:
        path = REFERENCE[options.device]
        model = json.loads(path.read_text(encoding="utf-8"))
        taught(model["seconds"], options.runs)
        write_json(options.output or path, model)
        return 0
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
