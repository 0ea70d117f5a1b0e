"""Time and check the enclosing-ellipsoid ops on one device: a table, and JSON with --json.

Kernel time is the median of --repeats calls of the registered op (no argument checks); `op` is the
same through gsfluent.ops, checks included. `outside` and `volume` compare the first --checked rows
with float64 fits on the CPU: how far the float64 ellipsoid's lens points reach out, and the ratio
of volumes.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.figure.markdown import enter
from gsfluent.ops.reference import mvee as reference

Pairs = tuple[Tensor, Tensor, Tensor, Tensor]


def rotations(count: int, generator: torch.Generator) -> Tensor:
    q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    return q * torch.diagonal(r, dim1=1, dim2=2).sign()[:, None]


def covariances(count: int, ratio: float, generator: torch.Generator) -> Tensor:
    """Covariances of random orientation with axis ratios up to `ratio`, [count, 3, 3]."""
    axes = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    scale = torch.exp(-axes * torch.log(torch.tensor(ratio, dtype=torch.float64)))
    turn = rotations(count, generator)
    return 0.25 * (turn * scale[:, None] ** 2) @ turn.mT


def family(name: str, count: int, seed: int = 3) -> Pairs:
    """Pairs of Gaussians, float64 on the CPU; see the table's names."""
    generator = torch.Generator().manual_seed(seed)
    ratio = {"balls": 1.0, "ratio 4": 4.0, "near balls": 1.05}.get(name, 40.0)
    cov_a = covariances(count, ratio, generator)
    cov_b = covariances(count, ratio, generator)
    if name == "balls":
        size = 0.5 + torch.rand(count, 1, 1, generator=generator, dtype=torch.float64)
        cov_b = cov_a * size**2
    if name == "same shape":
        cov_a = covariances(count, 4.0, generator)
        cov_b = 1.5 * cov_a
    if name == "contained":
        cov_b = 0.01 * cov_a + 0.001 * cov_b
    mean_a = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    away = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    away /= away.norm(dim=1, keepdim=True)
    # Along `away` the ellipsoids certainly touch between these distances.
    reach = sum((2.0 / (away[:, None] @ torch.linalg.inv(c) @ away[..., None])[:, 0, 0].sqrt())
                for c in (cov_a, cov_b))  # fmt: skip
    part = torch.rand(count, generator=generator, dtype=torch.float64)
    part = 1.0 - 0.03 * part if name == "thin" else 0.02 * part if name == "contained" else part
    return mean_a, cov_a, mean_a + (part * reach)[:, None] * away, cov_b


def timed(call: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Median seconds of one call."""
    call()
    seconds = []
    for _ in range(repeats):
        if device.type == "cuda":
            torch.cuda.synchronize()
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            call()
            end.record()
            torch.cuda.synchronize()
            seconds.append(start.elapsed_time(end) / 1e3)
        else:
            begin = time.process_time()
            call()
            seconds.append(time.process_time() - begin)
    return statistics.median(seconds)


def volume(shape: Tensor) -> Tensor:
    return torch.linalg.det(shape.double()).clamp(min=0.0).sqrt()


def reach(points: Tensor, center: Tensor, shape: Tensor) -> Tensor:
    offset = points - center.double()[:, None]
    inverse = torch.linalg.inv(shape.double())
    return (offset @ inverse * offset).sum(2).amax(1).sqrt()


def check_pairs(
    pairs: Pairs, checked: int, device: torch.device, dtype: torch.dtype
) -> dict[str, Any]:
    """Largest distance outside and the volumes' ratio, of the first rows, against float64."""
    few = tuple(p[:checked].to(dtype) for p in pairs)
    mean, cov, overlap = (t.cpu() for t in ops.mvee_lens(*(p.to(device) for p in few)))
    wide = tuple(p.double() for p in few)
    _, want, want_overlap = ops.mvee_lens(*wide)
    both = overlap & want_overlap
    if not bool(both.any()):
        return {"overlapping": 0}
    points, _ = reference.lens_points(*(p[both] for p in wide), radius=2.0, count=500)
    outside = reach(points, mean[both], 4.0 * cov[both]) - 1.0
    ratio = volume(cov[both]) / volume(want[both])
    return {
        "overlapping": int(both.sum()),
        "disagree": int((overlap != want_overlap).sum()),
        "outside": float(outside.max()),
        "volume_low": float(ratio.min()),
        "volume_high": float(ratio.max()),
    }


def bench(args: argparse.Namespace) -> list[dict[str, Any]]:
    device, dtype = torch.device(args.device), getattr(torch, args.dtype)
    rows = []
    lens, enclose = torch.ops.gsfluent.mvee_lens.default, torch.ops.gsfluent.mvee.default
    for name in args.families:
        pairs = family(name, args.pairs)
        given = tuple(p.to(device, dtype) for p in pairs)
        packed = [c.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]].contiguous() for c in given[1::2]]
        raw = (given[0], packed[0], given[2], packed[1], 2.0, 0.0)
        row: dict[str, Any] = {"case": f"{args.pairs} pairs, {name}"}
        row["kernel_ms"] = 1e3 * timed(partial(lens, *raw), device, args.repeats)
        row["op_ms"] = 1e3 * timed(
            partial(ops.mvee_lens, given[0], packed[0], given[2], packed[1]), device, args.repeats
        )
        row["share"] = float(lens(*raw)[2].float().mean())
        rows.append(row | check_pairs(pairs, args.checked, device, dtype))
    for count in args.points:
        sets = min(args.pairs, 2**26 // count)
        generator = torch.Generator().manual_seed(5)
        points = torch.randn(sets, count, 3, generator=generator).to(dtype)
        few = points[: args.checked].double()
        points = points.to(device)
        row = {"case": f"{sets} sets of {count} points"}
        row["kernel_ms"] = 1e3 * timed(
            partial(enclose, points, 5e-4, 100), device, max(1, args.repeats // 2)
        )
        center, shape = (t.cpu() for t in enclose(points[: args.checked], 5e-4, 100))
        _, want = ops.mvee(few, tolerance=1e-7)
        ratio = volume(shape) / volume(want)
        row["outside"] = float((reach(few, center, shape) - 1.0).max())
        row["volume_low"], row["volume_high"] = float(ratio.min()), float(ratio.max())
        rows.append(row)
    return rows


def saved_table(text: str) -> str:
    """The Markdown table of a saved run: times only."""
    lines = ["| case | kernel ms | through ops, ms |", "|---|---|---|"]
    for line in text.splitlines():
        found = re.match(r"(\d+ .*?)\s+kernel_ms (\S+)(?:\s+op_ms (\S+))?", line)
        if found:
            times = [f"{float(t):.2f}" if t else "" for t in found.groups()[1:]]
            lines.append(f"| {found.group(1)} | {times[0]} | {times[1]} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--dtype", default="float32", choices=["float32", "float64"])
    parser.add_argument("--pairs", type=int, default=1_000_000)
    parser.add_argument("--checked", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--points", type=int, nargs="*", default=[16, 64, 256, 2048])
    families = ["balls", "same shape", "contained", "near balls", "ratio 4", "ratio 40", "thin"]
    parser.add_argument("--families", nargs="*", default=families, choices=families)
    parser.add_argument("--json", action="store_true", help="print JSON and no table")
    parser.add_argument("--saved", type=Path, help="a saved table instead of a run")
    parser.add_argument("--page", type=Path, help="enter the table into this page")
    args = parser.parse_args()
    if args.saved is not None and args.page is not None:
        table = saved_table(args.saved.read_text())
        args.page.write_text(enter(args.page.read_text(), "mvee speed", table))
        return 0
    rows = bench(args)
    if args.json:
        sys.stdout.write(json.dumps(rows, indent=1) + "\n")
        return 0
    keys = ["kernel_ms", "op_ms", "share", "outside", "volume_low", "volume_high"]
    for row in rows:
        values = "  ".join(f"{k} {row[k]:.6g}" for k in keys if k in row)
        sys.stdout.write(f"{row['case']:36s} {values}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
