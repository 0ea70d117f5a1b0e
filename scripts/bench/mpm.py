"""Time a whole step of the resident solver on the falling-cube scenes of PhysGaussian's benchmark.

python scripts/bench/mpm.py                                    # this machine's GPU, else its CPU
python scripts/bench/mpm.py --device cpu --markdown docs/measured/benchmarks.md  # one core
python scripts/bench/mpm.py --json bench_mpm.json --markdown docs/measured/benchmarks.md
python scripts/bench/mpm.py --peer peer.json     # from physgaussian.py on the same machine
python scripts/bench/mpm.py --devices 1 2 4 --rows 200:100 300:136
python scripts/bench/mpm.py --measured a.json b.json --markdown docs/measured/benchmarks.md

With --profile too: what each GPU does in a step, kernel by kernel.
With --devices: the elastic scenes on so many GPUs of this host, and whether points end with the
bits of one: their digests, and up to 25 million points all bits. Points wait in host memory and go
to the devices some at a time; from 200 million points on runs are of 20 steps.

Scene (shared/spec/baselines.md section 2): domain [0, 2]^3, dx = 2 / n, a cube of m^3 cells with
eight jittered points each, bottom at four cells, v0 = (0, 0, -3), g = (0, 0, -9.8), rho = 1000,
E = 1e5, nu = 0.3, dt = 1e-4, walls three cells inside the domain. 50 steps to warm up, then the
median of five runs of 100 steps; the clock is read once per run. PhysGaussian's column is what
--peer holds, else the figure of that table: CUDA graph, same scene, same kind of GPU. On the CPU:
one thread, process time, the least of the five runs, and beside it the plain C++ solver of
shared/spec/solver.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import has_cuda, ops
from gsfluent.figure.markdown import enter

PEER = {  # (grid, cells, order) -> ms per substep, warp-lang 0.10.1, CUDA graph, H100
    (100, 24, "lattice"): 0.209, (100, 24, "random"): 0.275,
    (200, 50, "lattice"): 1.508, (200, 50, "random"): 1.859,
    (200, 80, "lattice"): 4.958, (200, 80, "random"): 6.416,
    (300, 100, "lattice"): 10.272, (300, 100, "random"): 13.009,
}  # fmt: skip
BARS = {
    (100, 24, "lattice"): 0.03, (100, 24, "random"): 0.03,
    (200, 50, "lattice"): 0.15, (200, 50, "random"): 0.17,
    (200, 80, "lattice"): 0.50, (200, 80, "random"): 0.58,
    (300, 100, "lattice"): 1.0, (300, 100, "random"): 1.1,
}  # fmt: skip
CPU_PEER, CPU_BAR = {(100, 24): 47.5}, {(100, 24): 12.0}
BYTES = {"elastic": 208, "nacc": 224, "relaxing": 292}
"""Bytes a point must move in a step: p2g reads 68, g2p reads 48 and writes 92 (NACC 16 more, its
branch 68)."""


def walls(n: int, dx: float, device: torch.device) -> Tensor:
    rows = []
    for axis in range(3):
        for side in (1.0, -1.0):
            normal = [side if a == axis else 0.0 for a in range(3)]
            point = [3 * dx if side > 0 else 2.0 - 3 * dx] * 3
            rows.append([0.0, 2.0, 0.0, *point, *normal] + [0.0] * 7)
    return torch.tensor(rows, device=device)


def points(n: int, cells: int, order: str, device: torch.device) -> tuple[Tensor, float]:
    dx = 2.0 / n
    generator = torch.Generator().manual_seed(0)
    axis = torch.arange(cells)
    cell = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 1, 3)
    half = torch.stack(torch.meshgrid(*[torch.arange(2)] * 3, indexing="ij"), -1).reshape(1, 8, 3)
    jitter = torch.rand(cell.shape[0], 8, 3, generator=generator)
    low = torch.tensor([1.0 - 0.5 * cells * dx, 1.0 - 0.5 * cells * dx, 4 * dx])
    x = low + (cell + 0.5 * (half + jitter)) * dx
    x = x.reshape(-1, 3)
    if order == "random":
        x = x[torch.randperm(x.shape[0], generator=generator)]
    return x.to(device), dx


def build(n: int, cells: int, order: str, kind: str, device: torch.device) -> ops.Solver:
    x, dx = points(n, cells, order, device)
    count = x.shape[0]
    young, nu = 1e5, 0.3
    row = [young / (2 * (1 + nu)), young / (3 * (1 - 2 * nu)), 1.85, 0.6, 3.0, 0.0, 1000.0, 0.0]
    velocity = torch.zeros(count, 3, device=device)
    velocity[:, 2] = -3.0
    volume = torch.full((count,), dx**3 / 8, device=device)
    body = None
    if kind in ("two", "apart"):  # the upper half is another body; "apart": 0.3 m higher up
        middle = 4 * dx + 0.5 * cells * dx
        body = (x[:, 2] > middle).to(torch.int32)
        if kind == "apart":
            x[:, 2] += 4 * round(0.3 / (4 * dx)) * dx * body  # whole blocks
    law = 1 if kind in ("nacc", "relaxing") else 0
    branch = None
    if kind == "relaxing":  # nacc with a share of 0.5 that relaxes in 10 ms
        branch = torch.zeros(count, 9, device=device)
        branch[:, 6], branch[:, 7] = 0.5, 100.0
    return ops.Solver(
        x, velocity, 1000.0 * volume, volume, dx=dx, dt=1e-4, gravity=(0.0, 0.0, -9.8),
        law=torch.tensor([law], dtype=torch.int32, device=device), body=body,
        params=torch.tensor([row], device=device), colliders=walls(n, dx, device),
        alpha=torch.full((count,), -0.4, device=device) if law else None, viscous=branch,
    )  # fmt: skip


def seconds_per_step(solver: ops.Solver, steps: int, runs: int) -> list[float]:
    def wait() -> None:
        if solver.device.type == "cuda":
            torch.cuda.synchronize()

    alone = solver.device.type == "cpu" and torch.get_num_threads() == 1
    clock = time.process_time if alone else time.perf_counter
    times = []
    for _ in range(runs):
        wait()
        start = clock()
        solver.advance(steps=steps)
        wait()
        times.append((clock() - start) / steps)
    return sorted(times)


def measure(n: int, cells: int, order: str, kind: str, device: torch.device) -> dict[str, Any]:
    solver = build(n, cells, order, kind, device)
    solver.advance(steps=50)
    times = seconds_per_step(solver, 100, 5)
    # Others work on the machine too: the least is what the code needs of a core.
    middle = times[len(times) // 2] if device.type == "cuda" else times[0]
    counters = solver.counters()
    need = BYTES.get(kind, BYTES["elastic"]) * solver.count
    height = float(solver.position[:, 2].mean())
    return {
        "grid": n, "cells": cells, "order": order, "kind": kind, "particles": solver.count,
        "ms": 1e3 * middle, "ms_best": 1e3 * times[0],
        "ns_per_particle": 1e9 * middle / solver.count,
        "gb_per_second": need / middle / 1e9, "memory_mib": solver.memory() / 2**20,
        "builds_per_step": counters["builds"] / counters["step"], "mean_height": height,
        "slots": counters["slots"], "homes": counters["homes"],
    }  # fmt: skip


STATE = ("position", "velocity", "affine", "strain")
EXACT = 25_000_000
"""Points up to which all bits are compared, beside their digests."""
FEW_STEPS = 200_000_000
"""Points from which runs are of 20 steps."""


def points_on_host(n: int, cells: int) -> Tensor:
    """The cube's points in host memory, made on a GPU layer by layer."""
    device, dx = torch.device("cuda:0"), 2.0 / n
    generator = torch.Generator(device).manual_seed(0)
    axis, pair = torch.arange(cells, device=device), torch.arange(2, device=device)
    half = torch.stack(torch.meshgrid(pair, pair, pair, indexing="ij"), -1).reshape(1, 8, 3)
    low = torch.tensor([1.0 - 0.5 * cells * dx, 1.0 - 0.5 * cells * dx, 4 * dx], device=device)
    out = torch.empty(cells, 8 * cells**2, 3)
    for x in range(cells):
        cell = torch.stack(torch.meshgrid(axis[x : x + 1], axis, axis, indexing="ij"), -1)
        jitter = torch.rand(cells**2, 8, 3, generator=generator, device=device)
        place = low + (cell.reshape(-1, 1, 3) + 0.5 * (half + jitter)) * dx
        out[x] = place.reshape(-1, 3)
    return out.reshape(-1, 3)


def on_devices(x: Tensor, n: int, count: int) -> ops.Solver:
    """The elastic scene of :func:`build` on so many GPUs, its points from host memory."""
    dx, young, nu = 2.0 / n, 1e5, 0.3
    row = [young / (2 * (1 + nu)), young / (3 * (1 - 2 * nu)), 1.85, 0.6, 3.0, 0.0, 1000.0, 0.0]
    volume = torch.tensor(dx**3 / 8).expand(len(x))
    return ops.Solver(
        x, torch.tensor([0.0, 0.0, -3.0]).expand_as(x), (1000.0 * volume[0]).expand(len(x)), volume,
        dx=dx, dt=1e-4, gravity=(0.0, 0.0, -9.8), law=torch.tensor([0], dtype=torch.int32),
        params=torch.tensor([row]), colliders=walls(n, dx, torch.device("cpu")),
        devices=[f"cuda:{i}" for i in range(count)],
    )  # fmt: skip


def digest(solver: ops.Solver, name: str) -> int:
    """One number of the bits of all points, whichever order they lie in."""
    total = 0
    for index, values in solver.chunks(name):
        rows = values.reshape(len(index), -1).contiguous()
        words = rows.view(torch.int64 if rows.dtype == torch.float64 else torch.int32).long()
        for column in range(rows.shape[1]):
            mixed = (index * 1_000_003 + column + 1) * 0x1B87_3593_9E37_79B1 ^ words[:, column]
            mixed = (mixed ^ mixed >> 29) * 0x3F58_476D_1CE4_E5B9
            total += int((mixed ^ mixed >> 32).sum())
    return total % 2**64


def scaling(n: int, cells: int, counts: list[int]) -> list[dict[str, Any]]:
    """One scene on several numbers of devices; the bits of the first are those to have."""
    rows: list[dict[str, Any]] = []
    wanted: list[Any] = []
    x = points_on_host(n, cells)
    steps = 20 if len(x) > FEW_STEPS else 100
    for count in counts:
        for i in range(count):
            torch.cuda.reset_peak_memory_stats(i)
        start = time.perf_counter()
        solver = on_devices(x, n, count)
        loading = time.perf_counter() - start
        solver.advance(steps=steps // 2)
        times = seconds_per_step(solver, steps, 5)
        found: list[Any] = [digest(solver, name) for name in STATE]
        if solver.count <= EXACT:
            found += [getattr(solver, name) for name in STATE]
        wanted = wanted or found
        parts = solver.rank_counts() if count > 1 else []
        rows.append({
            "grid": n, "cells": cells, "particles": solver.count, "devices": count,
            "ms": 1e3 * times[len(times) // 2], "ms_best": 1e3 * times[0],
            "same_bits": all(
                torch.equal(a, b) if isinstance(a, Tensor) else a == b
                for a, b in zip(found, wanted, strict=True)
            ),
            "exact": solver.count <= EXACT, "loading": loading,
            "shared": max((part["shared"] for part in parts), default=0),
            "memory_mib": solver.memory() / 2**20,
            "peak_gb": max(torch.cuda.max_memory_allocated(i) for i in range(count)) / 1e9,
        })  # fmt: skip
        rows[-1]["times"] = rows[0]["ms"] / rows[-1]["ms"]
        sys.stderr.write(f"{json.dumps(rows[-1])}\n")
        del solver
        torch.cuda.empty_cache()
    return rows


def profile(n: int, cells: int, count: int) -> str:
    """Microseconds of a step by kernel on each of so many GPUs, and how long each was idle."""
    devices = [f"cuda:{i}" for i in range(count)]
    solver = on_devices(points_on_host(n, cells), n, count)
    solver.advance(steps=100)
    steps = 100
    kinds = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as seen:
        solver.advance(steps=steps)
        for device in devices:
            torch.cuda.synchronize(device)
    spans: dict[int, list[tuple[float, float, str]]] = {}
    for event in seen.events():
        name = event.name.split("<")[0].split("::")[-1].removeprefix("void ")
        span = (event.time_range.start, event.time_range.end, name)
        spans.setdefault(event.device_index, []).append(span)
    lines = [f"{solver.count:,} points, {count} GPU(s); us a step, of {steps} steps"]
    for card, found in sorted(spans.items()):
        total: dict[str, list[float]] = {}
        for start, end, name in found:
            total.setdefault(name, []).append(end - start)
        whole = max(end for _, end, _ in found) - min(start for start, _, _ in found)
        busy = sum(sum(times) for times in total.values())
        lines.append(f"cuda:{card}: {whole / steps:.1f}, of them idle {(whole - busy) / steps:.1f}")
        for name, times in sorted(total.items(), key=lambda item: -sum(item[1]))[:24]:
            lines.append(f"  {name:<28}{sum(times) / steps:9.2f}  {len(times)} times")
    return "\n".join(lines) + "\n"


def scaling_table(name: str, rows: list[dict[str, Any]], torch_name: str) -> str:
    lines = [
        f"Device: {name}; torch {torch_name}. Elastic, lattice. Whole steps, with builds.",
        "",
        "| points | devices | ms | times the first | bits of the first | shared blocks | "
        "loading [s] | most memory of one [GB] |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {r['particles']:,} | {r['devices']} | {r['ms']:.4f} | {r['times']:.2f} | "
        f"{'yes' if r['same_bits'] else 'no'} | {r['shared']} | {r['loading']:.1f} | "
        f"{r['peak_gb']:.1f} |"
        for r in rows
    ]
    return "\n".join(lines) + "\n"


def bar_and_peer(row: dict[str, Any], gpu: bool) -> tuple[float | None, float | None]:
    if row["kind"] != "elastic":
        return None, None
    key = (row["grid"], row["cells"])
    if not gpu:
        return CPU_BAR.get(key), CPU_PEER.get(key)
    return BARS.get((*key, row["order"])), PEER.get((*key, row["order"]))


def markdown(name: str, rows: list[dict[str, Any]], gpu: bool) -> str:
    other = "PhysGaussian" if gpu else "plain C++"
    lines = [
        f"Device: {name}; torch {torch.__version__}. Times are of whole steps, builds included.",
        "",
        "| scene | points | order | ms | ns/point | GB/s needed | memory MiB | bar ms | "
        f"{other} ms | ratio |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        bar, peer = bar_and_peer(r, gpu)
        ratio = f"{peer / r['ms']:.1f}" if peer else ""
        lines.append(
            f"| {r['kind']}, {r['grid']}^3 | {r['particles']:,} | {r['order']} | {r['ms']:.4f} | "
            f"{r['ns_per_particle']:.3f} | {r['gb_per_second']:.0f} | {r['memory_mib']:.0f} | "
            f"{bar or ''} | {peer or ''} | {ratio} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument("--threads", type=int, default=1, help="CPU; with several: wall time")
    parser.add_argument("--rows", nargs="*", help="grid:cells, for example 200:50")
    parser.add_argument("--kinds", nargs="*", default=["elastic", "nacc", "two", "apart"])
    parser.add_argument("--orders", nargs="*", default=["lattice", "random"])
    parser.add_argument("--peer", type=Path, help="what physgaussian.py wrote")
    parser.add_argument("--devices", nargs="*", type=int, help="numbers of GPUs: 1 2 4")
    parser.add_argument("--profile", action="store_true", help="with --devices: kernel by kernel")
    parser.add_argument("--measured", type=Path, nargs="*", help="--json of --devices: only enter")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    if options.peer:
        for row in json.loads(options.peer.read_text())["rows"]:
            PEER[row["grid"], row["cells"], row["order"]] = round(row["ms"], 3)
    if options.measured:
        found = [json.loads(path.read_text()) for path in options.measured]
        rows = [row for one in found for row in one["rows"]]
        name, torch_name = found[0]["device"], found[0].get("torch", torch.__version__)
        table = scaling_table(name, rows, torch_name)
        return leave(options, "bench_mpm devices", table, name, rows)
    if options.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no GPU, or gsfluent was built without its CUDA kernels")
    gpu = options.device == "cuda" or (options.device == "auto" and has_cuda())
    device = torch.device("cuda" if gpu else "cpu")
    if not gpu:
        torch.set_num_threads(options.threads)
    if options.devices:
        there = torch.cuda.device_count() if gpu else 0
        if not 1 <= min(options.devices) <= max(options.devices) <= there:
            parser.error(f"--devices: this machine has {there}, got {options.devices}")
        rows = []
        for text in options.rows or ["200:100", "300:136"]:
            n, cells = (int(part) for part in text.split(":"))
            if options.profile:
                sys.stdout.writelines(profile(n, cells, count) for count in options.devices)
                continue
            rows += scaling(n, cells, options.devices)
        if options.profile:
            return 0
        name = torch.cuda.get_device_name()
        table = scaling_table(name, rows, torch.__version__)
        return leave(options, "bench_mpm devices", table, name, rows)
    default = ["100:24", "200:50", "200:80", "300:100"] if gpu else ["100:24"]
    rows = []
    for text in options.rows or default:
        n, cells = (int(part) for part in text.split(":"))
        for kind in options.kinds:
            for order in options.orders:
                row = measure(n, cells, order, kind, device)
                rows.append(row)
                sys.stderr.write(
                    f"{kind} {n}^3 {row['particles']:,} {order}: {row['ms']:.4f} ms, "
                    f"{row['ns_per_particle']:.3f} ns, {row['memory_mib']:.0f} MiB, "
                    f"builds/step {row['builds_per_step']:.3f}, height {row['mean_height']:.4f}\n"
                )
    name = torch.cuda.get_device_name() if gpu else f"{platform.processor() or platform.machine()}"
    if not gpu:
        kind = "process" if options.threads == 1 else "wall"
        name += f", {options.threads} thread(s), {kind} time, load {os.getloadavg()[0]:.1f}"
    part = "bench_mpm" if gpu else f"bench_mpm {'cpu' if options.threads == 1 else 'threads'}"
    return leave(options, part, markdown(name, rows, gpu), name, rows)


def leave(
    options: argparse.Namespace, part: str, text: str, name: str, rows: list[dict[str, Any]]
) -> int:
    """Print the table; write it and the rows to where they were asked for."""
    sys.stdout.write(text)
    if options.json:
        options.json.write_text(
            json.dumps({"device": name, "torch": torch.__version__, "rows": rows}, indent=1) + "\n"
        )
    if options.markdown:
        page = options.markdown
        old = page.read_text() if page.exists() else ""
        page.write_text(enter(old, part, text.rstrip()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
