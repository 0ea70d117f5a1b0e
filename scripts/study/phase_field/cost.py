"""What a step of phase-field matter takes beside one of NACC, before it cracks and meanwhile.

    python scripts/study/phase_field/cost.py OUT [--device cuda] [--points 50000 200000 1000000]

A bar of E 1e5 Pa and 1000 kg/m^3, three times as long as wide, jittered points, eight a cell, steps
of fixed length, each law in turn. Before: it trembles below its strength. Meanwhile: its halves are
pulled apart until it is broken in the middle. On the CPU one thread and process time, on a GPU
wall time. Leaves cost_DEVICE.json in OUT, which run.py --enter reads.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent import ops
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.record import machine

DX, DT = 0.01, 2e-4
MU, KAPPA = 4e4, 6.7e4
STEPS, TURNS, LEAD = 40, 5, 20
ROWS = {  # law and columns 2 to 5; both break at about the same strain
    "nacc": (1, [1.85, 0.5, 3.0, 0.1]),
    "phase_field": (9, [30.0, 0.0, 2.0 * DX, 0.0]),
}
ALPHA = {"nacc": -0.02, "phase_field": -1.0}


def bar(points: int, law: str, pulled: bool, device: str) -> ops.Solver:
    """The bar under a law, before its first step."""
    wide = max(4, round((points / 24.0) ** (1.0 / 3.0)))
    generator = torch.Generator().manual_seed(0)
    axes = (torch.arange(2 * n, dtype=torch.float64) + 0.5 for n in (3 * wide, wide, wide))
    x = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    x = 0.5 * DX * (x + 0.5 * (torch.rand(x.shape, generator=generator, dtype=x.dtype) - 0.5))
    count = x.shape[0]
    v = 1e-3 * torch.randn(count, 3, generator=generator)
    if pulled:
        v[:, 0] = 0.4 * (8.0 * (x[:, 0] / DX - 1.5 * wide)).sign().float()
    volume = torch.full((count,), DX**3 / 8.0)
    number, columns = ROWS[law]
    given: dict[str, Any] = {
        "law": torch.tensor([number], dtype=torch.int32),
        "params": torch.tensor([[MU, KAPPA, *columns, 1000.0, 0.0]]),
        "alpha": torch.full((count,), ALPHA[law]),
    }
    moved = {name: value.to(device) for name, value in given.items()}
    return ops.Solver(
        x.to(device), v.to(device), (1000.0 * volume).to(device), volume.to(device), dx=DX, dt=DT,
        gravity=(0.0, 0.0, 0.0), **moved,
    )  # fmt: skip


def timed(solver: ops.Solver) -> float:
    """Seconds of so many steps."""
    cuda = solver.device.type == "cuda"
    clock = time.perf_counter if cuda else time.process_time
    if cuda:
        torch.cuda.synchronize()
    begin = clock()
    solver.advance(steps=STEPS)
    if cuda:
        torch.cuda.synchronize()
    return clock() - begin


def measure(points: int, pulled: bool, device: str) -> dict[str, Any]:
    """Milliseconds a step of both laws."""
    solvers = {law: bar(points, law, pulled, device) for law in ROWS}
    for solver in solvers.values():
        solver.advance(steps=LEAD)
    spent: dict[str, list[float]] = {law: [] for law in ROWS}
    for _ in range(TURNS):  # in turn: what else works on the machine slows both
        for law, solver in solvers.items():
            spent[law].append(timed(solver))
    middle = {
        law: 1e3 * statistics.median(values) / STEPS if device == "cuda"
        else 1e3 * min(values) / STEPS if not pulled
        else 1e3 * sum(values) / STEPS / TURNS
        for law, values in spent.items()
    }  # fmt: skip
    broken = {law: float((s.peak >= 0.0).double().mean()) for law, s in solvers.items()}
    count = solvers["nacc"].count
    return {
        "points": count, "pulled": pulled, "ms": middle, "broken": broken,
        "ratio": middle["phase_field"] / middle["nacc"],
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--points", type=int, nargs="+", default=[])
    args = parser.parse_args()
    if args.device == "cpu":
        torch.set_num_threads(1)
    sizes = args.points or ([200_000, 1_000_000] if args.device == "cuda" else [50_000])
    rows = []
    for points in sizes:
        for pulled in (False, True):
            rows.append(measure(points, pulled, args.device))
            sys.stderr.write(f"{json.dumps(rows[-1])}\n")
    args.out.mkdir(parents=True, exist_ok=True)
    found = {"test": "cost", "device": args.device, "machine": machine(args.device), "rows": rows}
    with atomic_path(args.out / f"cost_{args.device}.json") as path:
        path.write_text(json.dumps(found), encoding="utf-8")
    return 0 if all(math.isfinite(row["ratio"]) for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
