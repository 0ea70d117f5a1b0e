"""Errors of every op: the CPU against the float64 reference, CUDA against the CPU.

    python scripts/accuracy/ops.py --markdown docs/measured/accuracy.md    # the CPU part
    python scripts/accuracy/ops.py --device cuda --json a.json      # on a machine with a GPU
    python scripts/accuracy/ops.py --table a.json --markdown docs/measured/accuracy.md

Every precision gets the same float32 inputs. An error is the largest difference over the largest
value. An entry beyond the bar is excused only where the op decides something (which splats pass the
1/255 cut, which of several roots is taken) and the float64 result itself moves beyond the bar when
the inputs move by four float32 roundings; excused entries are counted, and more than one in a
thousand fails. Exit code 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from ops_cases import (
    DX,
    Case,
    Results,
    loss_cases,
    material_cases,
    melon,
    mpm_cases,
    mvee_cases,
    raster_cases,
)
from torch import Tensor

from gsfluent import has_cuda, ops
from gsfluent.figure.markdown import enter
from gsfluent.ops.blocks import Blocks, build_blocks_on_device

BARS = {"cpu": 1e-5, "cuda": 2e-4}  # float32
BAR_DOUBLE = 1e-10
TRIALS, ROUNDINGS = 24, 4.0  # of the excuse
EXCUSED_SHARE = 1e-3
ORDINARY, QUICK = (20_000, 200, 60_000), (600, 8, 1500)  # particles, fits, splats


def place(inputs: dict[str, Any], device: str, dtype: torch.dtype) -> dict[str, Any]:
    """Copies on ``device``, floating ones in ``dtype``."""

    def move(value: Any) -> Any:
        if isinstance(value, Blocks):
            return Blocks(*(move(v) for v in value))
        if isinstance(value, Tensor):
            return value.to(device, dtype if value.is_floating_point() else value.dtype)
        return value

    return {name: move(value) for name, value in inputs.items()}


def shaken(inputs: dict[str, Any], seed: int, size: float) -> dict[str, Any]:
    """Float64 copies whose entries moved by up to ``size``, relatively."""
    generator = torch.Generator().manual_seed(seed)
    moved = place(inputs, "cpu", torch.float64)
    for name, value in moved.items():
        if isinstance(value, Tensor) and value.is_floating_point() and "seed" not in name:
            noise = torch.rand(value.shape, generator=generator, dtype=torch.float64)
            moved[name] = value * (1.0 + size * (2.0 * noise - 1.0))
    return moved


def distance(value: Tensor, truth: Tensor) -> Tensor:
    """Differences over the largest true value, the largest of each vector or small matrix."""
    truth = truth.detach().double().cpu()
    difference = (value.detach().double().cpu() - truth).abs()
    difference = torch.nan_to_num(difference, nan=float("inf"))
    while difference.dim() > 1 and difference.shape[-1] <= 6:
        difference = difference.amax(-1)
    return difference / truth.abs().max().clamp(min=1e-30)


def rows_of(case: Case, device: str, dtype: torch.dtype) -> Iterator[dict[str, Any]]:
    """One row per result of the op."""
    ours = case.call(ops, place(case.inputs, device, dtype))
    if device == "cuda":
        truth, against = case.call(ops, place(case.inputs, "cpu", dtype)), "CPU"
    elif case.reference is None:
        truth, against = case.call(ops, place(case.inputs, "cpu", torch.float64)), "float64 op"
    else:
        wide = place(case.inputs, "cpu", torch.float64)
        truth, against = case.call(case.reference, wide), "reference"
    bar = BAR_DOUBLE if dtype == torch.float64 else BARS[device]
    bar, note = (bar, "") if bar >= case.bars.get(dtype, 0.0) else (case.bars[dtype], case.note)
    trials: list[Results] = []
    for name, want in truth.items():
        error = distance(ours[name], want)
        beyond, excused = error > bar, torch.zeros_like(error, dtype=torch.bool)
        if case.jumps and bool(beyond.any()):
            if not trials:
                size = ROUNDINGS * torch.finfo(dtype).eps
                trials = [case.call(ops, shaken(case.inputs, i, size)) for i in range(TRIALS)]
                trials.insert(0, case.call(ops, place(case.inputs, "cpu", torch.float64)))
            for trial in trials[1:]:
                excused |= beyond & (distance(trial[name], trials[0][name]) > bar)
        left = torch.where(excused, 0.0, error)
        share = float(excused.double().mean())
        passed = float(left.max()) <= bar and share <= EXCUSED_SHARE
        yield {
            "device": device,
            "dtype": str(dtype).removeprefix("torch."),
            "op": case.name,
            "result": name,
            "against": against,
            "entries": error.numel(),
            "largest": float(error.max()),
            "beyond": int(beyond.sum()),
            "excused": int(excused.sum()),
            "reason": case.jumps if bool(excused.any()) else "",
            "largest_decided": float(left.max()),
            "bar": bar,
            "note": note,
            "passed": passed,
        }


def block_row(device: str, dtype: torch.dtype, count: int) -> dict[str, Any]:
    """build_blocks against its independent torch form (CPU) or the CPU (CUDA): exact."""
    position = melon(count)["position"].to(dtype)
    ours = ops.build_blocks(position.to(device), DX)
    found = [t.cpu() for t in (ours.table, ours.coords, ours.order, ours.start)]
    if device == "cuda":
        other = ops.build_blocks(position, DX)
        want = [other.table, other.coords, other.order, other.start]
    else:
        want = list(build_blocks_on_device(position, DX, 1, 2**20)[:4])
    same = [a.shape == b.shape for a, b in zip(found, want, strict=True)]
    pairs = zip(found, want, same, strict=True)
    wrong = sum(int((a != b).sum()) if s else max(a.numel(), b.numel()) for a, b, s in pairs)
    error = float(wrong > 0)
    return {
        "device": device,
        "dtype": str(dtype).removeprefix("torch."),
        "op": "build_blocks",
        "result": "table, coords, order, start",
        "against": "CPU" if device == "cuda" else "torch form",
        "entries": sum(t.numel() for t in want),
        "largest": error,
        "beyond": wrong,
        "excused": 0,
        "reason": "",
        "largest_decided": error,
        "bar": 0.0,
        "note": "",
        "passed": error == 0.0,
    }


def measure(device: str, sizes: tuple[int, int, int]) -> dict[str, Any]:
    particles, fits, count = sizes
    start, rows = time.perf_counter(), []
    dtypes = (torch.float32, torch.float64)
    rows += [block_row(device, dtype, particles) for dtype in dtypes]
    for case in (
        *mpm_cases(particles),
        *material_cases(particles),
        *mvee_cases(fits),
        *raster_cases(count),
        *loss_cases(particles),
    ):
        if device == "cuda" and case.reference is not None and "sampled" in case.name:
            continue  # a question to the reference
        for dtype in dtypes:
            if device == "cpu" and case.reference is None and dtype == torch.float64:
                continue  # would be compared with itself
            rows += rows_of(case, device, dtype)
        sys.stderr.write(f"{device} {case.name}: {time.perf_counter() - start:.1f} s\n")
    name = torch.cuda.get_device_name() if device == "cuda" else platform.processor()
    return {
        "device": device,
        "name": name or platform.machine(),
        "torch": torch.__version__,
        "sizes": dict(zip(("particles", "fits", "splats"), sizes, strict=True)),
        "seconds": time.perf_counter() - start,
        "rows": rows,
    }


def table(result: dict[str, Any]) -> str:
    rows = result["rows"]
    failed = sum(not row["passed"] for row in rows)
    verdict = f"**{failed} missed.**" if failed else "All within their bars."
    head = "op | result | precision | against | largest error | beyond / entries"
    lines = [
        f"{result['device']}: {result['name']}, torch {result['torch']}; {len(rows)} results. "
        + verdict,
        "",
        f"| {head} | excused | largest without them | bar | |",
        "|" + " --- |" * 10,
    ]
    for r in rows:
        excused = f"{r['excused']}: {r['reason']}" if r["excused"] else "0"
        bar = f"{r['bar']:.1e}" + (f" ({r['note']})" if r["note"] else "")
        lines.append(
            f"| {r['op']} | {r['result']} | {r['dtype']} | {r['against']} | {r['largest']:.1e} "
            f"| {r['beyond']} / {r['entries']} | {excused} | {r['largest_decided']:.1e} "
            f"| {bar} | {'pass' if r['passed'] else '**FAIL**'} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--quick", action="store_true", help="tiny sizes")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--markdown", type=Path, help="enter the table into this page")
    parser.add_argument("--table", type=Path, help="take an earlier --json; measure nothing")
    options = parser.parse_args(arguments)
    if options.table:
        result = json.loads(options.table.read_text())
    elif options.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no GPU, or gsfluent was built without its CUDA kernels")
    else:
        result = measure(options.device, QUICK if options.quick else ORDINARY)
    text = table(result)
    sys.stdout.write(text + "\n")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    if options.markdown:
        page = options.markdown
        before = page.read_text() if page.exists() else "# Accuracy of the ops\n"
        page.write_text(enter(before, result["device"], text))
    return 0 if all(row["passed"] for row in result["rows"]) else 1


if __name__ == "__main__":
    sys.exit(main())
