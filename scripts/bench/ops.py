"""Time every op; print markdown, optionally write JSON. Errors: scripts/accuracy/ops.py.

python scripts/bench/ops.py                         # this machine's CPU, and its GPU if any
python scripts/bench/ops.py --device cuda --json bench.json --markdown bench.md
python scripts/bench/ops.py --quick                 # a tenth of the size
python scripts/bench/ops.py --compare before.json   # beside an earlier run
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import has_cuda, ops
from gsfluent.materials import LAWS

DX = 0.01
DT = 1e-4


@dataclass(frozen=True)
class Case:
    """One op on one workload."""

    name: str
    unit: str
    count: int
    build: Callable[[torch.device, torch.dtype, int], Callable[[], Any]]


def random(shape: tuple[int, ...], seed: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)).to(device, dtype)


def points(count: int, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    side = (count / 8) ** (1 / 3) * DX  # eight per cell
    state = {
        "position": random((count, 3), 0, device, dtype) * side + 0.5,
        "velocity": random((count, 3), 1, device, dtype) - 0.5,
        "affine": random((count, 3, 3), 2, device, dtype) - 0.5,
        "mass": random((count,), 3, device, dtype) + 0.5,
        "stress": (random((count, 6), 4, device, dtype) - 0.5) * 1e3,
        "volume": torch.full((count,), DX**3 / 8, device=device, dtype=dtype),
    }
    return state


def scatter(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    p = points(count, device, dtype)
    blocks = ops.build_blocks(p["position"], DX)
    args = (p["position"], p["velocity"], p["affine"], p["mass"])
    extra = {"stress": p["stress"], "volume": p["volume"]}
    return lambda: ops.p2g(*args, dx=DX, blocks=blocks, dt=DT, **extra)[0]


def update(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    p = points(count, device, dtype)
    blocks = ops.build_blocks(p["position"], DX)
    grid, _ = ops.p2g(p["position"], p["velocity"], p["affine"], p["mass"], dx=DX, blocks=blocks)
    plane = [[0.0, 2.0, 0.4, 0, 0, 0.52, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]]
    floor = torch.tensor(plane, device=device, dtype=dtype)
    return lambda: ops.grid_update(grid, dx=DX, dt=DT, blocks=blocks, colliders=floor)[0]


def gather(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    p = points(count, device, dtype)
    blocks = ops.build_blocks(p["position"], DX)
    nodes = (1, blocks.coords.shape[0], 64, 3)
    field = random(nodes, 5, device, dtype) - 0.5
    rest = torch.eye(3, device=device, dtype=dtype).expand(count, 3, 3).contiguous()
    options = {"dx": DX, "dt": DT, "blocks": blocks, "deformation": rest}
    return lambda: ops.g2p(field, p["position"], **options)[1]


def yield_(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    strain = (random((count, 6), 6, device, dtype) - 0.5) * 0.1
    alpha = -0.08 * random((count,), 7, device, dtype)
    increment = (random((count, 3, 3), 8, device, dtype) - 0.5) * 0.05
    law = torch.tensor([1], dtype=torch.int32, device=device)
    row = [[3.6e4, 1.2e5, 1.85, 0.6, 3.0, 0.0, 1000.0, 0.0]]
    params = torch.tensor(row, device=device, dtype=dtype)
    return lambda: ops.return_mapping(strain, alpha, increment, law=law, params=params)[0]


def law_case(name: str, columns: tuple[float, ...]) -> Case:
    """One law on strains of a percent; ``columns`` are its numbers after the two moduli."""
    kind = name.split(",")[0]

    def build(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
        strain = (random((count, 6), 6, device, dtype) - 0.5) * 0.02
        strain[:, :3] -= 0.02  # pressed together, so that sand holds
        if kind == "fluid":
            strain[:, 1], strain[:, 2], strain[:, 3:] = strain[:, 0], strain[:, 0], 0.0
        alpha = torch.full((count,), -0.1 if kind == "nacc" else 0.0, device=device, dtype=dtype)
        increment = (random((count, 3, 3), 8, device, dtype) - 0.5) * 0.002
        row = [3.6e4, 1.2e5, *columns, 0.0, 0.0, 0.0, 0.0, 0.0][:6]
        params = torch.tensor([[*row, 1000.0, 0.0]], device=device, dtype=dtype)
        law = torch.tensor([LAWS[kind]], dtype=torch.int32, device=device)
        return lambda: ops.return_mapping(strain, alpha, increment, law=law, params=params, dt=DT)[
            0
        ]

    return Case(f"return_mapping: {name}", "particles", 200_000, build)


def splats(device: torch.device, dtype: torch.dtype, count: int) -> tuple[tuple, dict[str, Tensor]]:
    means = (random((count, 3), 9, device, dtype) - 0.5) * 0.3
    means[:, 2] += 1.0
    size = 0.5 * 0.3 / count ** (1 / 3)
    scales = size * (0.5 + random((count, 3), 10, device, dtype))
    focal = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], device=device, dtype=dtype)
    args = (means, random((count,), 11, device, dtype) * 0.8 + 0.1, torch.eye(4).to(means), focal)
    sh = (random((count, 4, 3), 13, device, dtype) - 0.5) * 0.5
    return args, {"quats": random((count, 4), 12, device, dtype) - 0.5, "scales": scales, "sh": sh}


def draw(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    args, extra = splats(device, dtype, count)
    return lambda: ops.rasterize(*args, 640, 480, **extra)[0]


def draw_backward(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    (means, opacities, view, focal), extra = splats(device, dtype, count)
    means.requires_grad_()

    def step() -> Tensor:
        means.grad = None
        image = ops.rasterize(means, opacities, view, focal, 640, 480, **extra)[0]
        (image * image).sum().backward()
        return means.grad

    return step


def enclose(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    cloud = random((count, 32, 3), 14, device, dtype)
    return lambda: ops.mvee(cloud, tolerance=1e-3)[1]


def compare(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    side = int(count**0.5)
    image, target = (random((side, side, 3), seed, device, dtype) for seed in (15, 16))
    image.requires_grad_()
    return lambda: torch.autograd.grad(ops.photometric_loss(image, target).loss, image)


def advance(device: torch.device, dtype: torch.dtype, count: int) -> Callable[[], Any]:
    state = [[random((count, 59), seed, device, dtype)] for seed in range(17, 21)]
    return lambda: ops.adam_step(*state, lr=1e-3, step=10)


# name, unit, full count, builder
CASES = [
    Case("p2g", "particles", 200_000, scatter),
    Case("grid_update", "particles", 200_000, update),
    Case("g2p", "particles", 200_000, gather),
    Case("return_mapping", "particles", 1_000_000, yield_),
    law_case("elastic", ()),
    law_case("corotated", ()),
    law_case("nacc, inside", (1.85, 0.6, 3.0)),
    law_case("nacc, yielding", (0.05, 0.6, 3.0)),
    law_case("von_mises, inside", (1e6,)),
    law_case("von_mises, yielding", (100.0,)),
    law_case("drucker_prager, inside", (10.0,)),
    law_case("drucker_prager, sliding", (0.01,)),
    law_case("fluid", (1.0,)),
    law_case("rigid", ()),
    Case("rasterize", "splats", 60_000, draw),
    Case("rasterize + backward", "splats", 60_000, draw_backward),
    Case("mvee", "fits", 20_000, enclose),
    Case("photometric_loss + backward", "pixels", 640_000, compare),
    Case("adam_step", "splats", 60_000, advance),
]


def clock_of(device: torch.device) -> Callable[[], float]:
    """Process time on one CPU thread, where other processes do not count; else wall time."""
    one = device.type == "cpu" and torch.get_num_threads() == 1
    return time.process_time if one else time.perf_counter


def seconds(call: Callable[[], Any], device: torch.device, budget: float) -> float:
    """Median of as many calls as fit the budget, at least three, after one warm-up."""
    clock = clock_of(device)

    def timed() -> float:
        start = clock()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return clock() - start

    timed()
    times: list[float] = []
    while len(times) < 3 or (sum(times) < budget and len(times) < 200):
        times.append(timed())
    return sorted(times)[len(times) // 2]


def measure(device: torch.device, *, quick: bool, budget: float, only: str) -> dict[str, Any]:
    rows = []
    for case in CASES:
        if only not in case.name:
            continue
        count = case.count // 10 if quick else case.count
        time_s = seconds(case.build(device, torch.float32, count), device, budget)
        rows.append(
            {
                "op": case.name,
                "unit": case.unit,
                "count": count,
                "seconds": time_s,
                "per_second": count / time_s,
            }
        )
        sys.stderr.write(f"{device} {case.name}: {1e3 * time_s:.3f} ms\n")
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor()
    return {
        "device": device.type,
        "name": name or platform.machine(),
        "threads": torch.get_num_threads(),
        "clock": clock_of(device).__name__,
        "load": os.getloadavg()[0],
        "torch": torch.__version__,
        "rows": rows,
    }


def markdown(results: list[dict[str, Any]], before: dict[str, float]) -> str:
    lines = []
    for result in results:
        lines += [
            f"### {result['device']}: {result['name']} (torch {result['torch']}, "
            f"{result['threads']} threads, {result['clock']}, load {result['load']:.1f})",
            "",
            "| op | size | ms | ns each | million/s |" + (" before, ms |" if before else ""),
            "| --- | --- | --- | --- | --- |" + (" --- |" if before else ""),
        ]
        for row in result["rows"]:
            size = f"{row['count']:,} {row['unit']}"
            line = f"| {row['op']} | {size} | {1e3 * row['seconds']:.3f} | "
            line += f"{1e9 / row['per_second']:.1f} | {row['per_second'] / 1e6:.2f} |"
            if before:
                line += f" {1e3 * before.get(result['device'] + row['op'], float('nan')):.3f} |"
            lines.append(line)
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["all", "cpu", "cuda"], default="all")
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    parser.add_argument("--budget", type=float, default=2.0, help="seconds per op")
    parser.add_argument("--only", default="", help="ops whose name holds this")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--markdown", type=Path, help="write the tables here")
    parser.add_argument("--compare", type=Path, help="an earlier --json file")
    options = parser.parse_args()
    if options.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no GPU, or gsfluent was built without its CUDA kernels")
    names = ["cpu"] if options.device != "cuda" else []
    if options.device != "cpu" and has_cuda():
        names.append("cuda")
    budget = 0.3 if options.quick else options.budget
    shared = {"quick": options.quick, "budget": budget, "only": options.only}
    results = [measure(torch.device(n), **shared) for n in names]
    before = {}
    if options.compare:
        old = json.loads(options.compare.read_text())
        before = {r["device"] + row["op"]: row["seconds"] for r in old for row in r["rows"]}
    text = markdown(results, before)
    sys.stdout.write(text)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    if options.markdown:
        options.markdown.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
