"""What holds the blocks of the grid after a fall: pieces, their cloud, or what lies about.

    python scripts/study/fracture_blocks.py --cells 16,20            # a minute of one core
    python scripts/study/fracture_blocks.py --cells 40,80 --device cuda

The watermelon of ``fracture_resolution.py`` from 3 m. At the last frame blocks are counted for each
piece alone, where it lies now and where it lay at rest, and for what hangs together in it now:
points that have fewer than 64 others of their piece within reach hold theirs for nothing. One JSON
line per fall; the table is entered into the page of the resolution.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from fracture_resolution import DROPS, LINES, PAGE, Trial
from rows import Row, add_law, append, law_of, numbers, put, read, table
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.charts.record import commit, machine
from gsfluent.pipeline.matter.pieces import LEAST
from gsfluent.pipeline.simulate.groups import grid_mask
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate

OUT = LINES.with_name("fracture_blocks.jsonl")
HEIGHT = "watermelon, 3 m"
NEAR = 2.0
"""Point spacings within which points of a piece hang together, whatever their links."""


def blocks(position: Tensor, dx: float) -> int:
    """Blocks of the grid that points [N, 3] reach."""
    return ops.build_blocks(position.float(), dx).coords.shape[0] if len(position) else 0


def touched(position: Tensor, dx: float) -> int:
    """Blocks with a node within the kernel of points [N, 3] as they are: those of blocks() have a
    cell to spare, so that they need not be built anew at every step."""
    cell = torch.floor(position.double() / dx - 0.5).to(torch.int64)
    ends = torch.stack([cell >> 2, (cell + 2) >> 2], dim=1)  # [N, 2, 3]
    corner = torch.cartesian_prod(*[torch.arange(2)] * 3)  # [8, 3]
    found = ends[:, corner, torch.arange(3)]
    return torch.unique(found.reshape(-1, 3), dim=0).shape[0]


def hanging(position: Tensor, unit: Tensor, reach: float) -> Tensor:
    """Points in heaps of at least 64 of their piece, bool [N]."""
    from scipy.spatial import cKDTree

    pairs = torch.from_numpy(cKDTree(position.numpy()).query_pairs(reach, output_type="ndarray"))
    pairs = pairs[unit[pairs[:, 0]] == unit[pairs[:, 1]]]
    heap = ops.components(pairs, len(position))
    return torch.bincount(heap, minlength=len(position))[heap] >= LEAST


def measure(run: Run) -> Row:
    """Blocks of the state that a run has reached."""
    state, matter = run.state, run.matter
    on_grid = grid_mask(state, matter).cpu()
    x, rest = state.position.cpu()[on_grid], matter.rest.cpu()[on_grid]
    ids, unit = torch.unique(state.unit.cpu()[on_grid], return_inverse=True)
    heaps = hanging(x, unit, NEAR * matter.dx / 2.0)
    order = torch.argsort(unit, stable=True)
    parts = order.split(torch.bincount(unit, minlength=len(ids)).tolist())
    now = [blocks(x[rows], matter.dx) for rows in parts]
    held = [blocks(x[rows[heaps[rows]]], matter.dx) for rows in parts]
    small = [i for i, rows in enumerate(parts) if len(rows) < 0.01 * matter.rest.shape[0]]
    return {
        "stored": run.stepper.blocks, "reached": blocks(x, matter.dx),
        "intact": blocks(matter.rest.cpu(), matter.dx),
        "touched": touched(x, matter.dx), "touched_intact": touched(matter.rest.cpu(), matter.dx),
        "pieces": len(ids), "now": sum(now), "held": sum(held),
        "rest": sum(blocks(rest[rows], matter.dx) for rows in parts),
        "small": len(small), "of_small": sum(now[i] for i in small),
        "astray": int((~heaps).sum()), "points": int(on_grid.sum()),
        "loose": int(state.loose.sum()),
    }  # fmt: skip


def fall(trial: Trial, cells: int, device: str) -> Row:
    """Let it fall and count."""
    sim = Simulate(
        dx=2.0 * max(trial.half) / cells, seed=0, repair=False, splats=False, device=device
    )
    spent = {"_regroup": 0.0}
    _timed(Run, "_regroup", spent, device)
    steps = sim(trial.scene(), fps=100.0, seconds=trial.begins + trial.seconds + 0.011)
    for _ in steps:
        pass
    report = steps.report
    return {
        "steps": report["substeps"], "blocks_mean": report["active_blocks_mean"],
        "seconds": round(report["seconds"], 2), "looks": round(spent["_regroup"], 2),
        **measure(steps.run),
    }  # fmt: skip


def _timed(owner: Any, name: str, spent: dict[str, float], device: str) -> None:
    """Add up the wall time of a method."""
    plain = getattr(owner, name)
    plain = getattr(plain, "untimed", plain)

    def timed(*args: Any, **named: Any) -> Any:
        begun = time.perf_counter()
        result = plain(*args, **named)
        if device == "cuda":
            torch.cuda.synchronize()
        spent[name] += time.perf_counter() - begun
        return result

    timed.untimed = plain  # type: ignore[attr-defined]
    setattr(owner, name, timed)


def page(rows: list[Row]) -> None:
    """Enter the table."""
    head = (
        "law", "cells", "blocks / intact", "of them reached", "touched / touched, intact",
        "pieces one by one, as at rest", "as they lie", "without points astray",
        "pieces below 1 %", "theirs", "points astray",
        "looks, s of all",
    )  # fmt: skip
    lines = [
        [
            r["law"], str(r["cells"]),
            *(f"{r[k] / r['intact']:.2f}" for k in ("stored", "reached")),
            f"{r['touched'] / r['touched_intact']:.2f}" if "touched" in r else "-",
            *(f"{r[k] / r['intact']:.2f}" for k in ("rest", "now", "held")),
            str(r["small"]), f"{r['of_small'] / r['intact']:.2f}",
            f"{100.0 * r['astray'] / r['points']:.2g} %",
            f"{r['looks']:.1f} of {r['seconds']:.1f}",
        ]
        for r in sorted(rows, key=lambda r: (r["device"], r["law"], r["cells"]))
    ]  # fmt: skip
    put(PAGE, "fracture resolution blocks", table(head, lines))


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    parser.add_argument("--cells", type=numbers, default=(16, 20, 24))
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    add_law(parser)
    args = parser.parse_args(argv)
    trial = dataclasses.replace(DROPS[HEIGHT], law=args.law)
    for cells in args.cells:
        key = {"law": law_of(trial.matter), "cells": cells, "device": args.device}
        if any(all(r.get(k) == v for k, v in key.items()) for r in read(args.out)):
            continue
        row = {
            **key, "machine": machine(args.device), "commit": commit(),
            **fall(trial, cells, args.device),
        }  # fmt: skip
        sys.stderr.write(f"{json.dumps(row)}\n")
        append(args.out, row)
    if args.out == OUT:
        page(read(args.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
