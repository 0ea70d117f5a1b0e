"""What the same bits cost on a GPU, and whether they are the same; docs/measured/deterministic.md.

    python scripts/bench/deterministic.py [--device cuda] [--splats 100000 1000000]
        [--size 1920x1080] [--views 24] [--iterations 1000] [--repeats 20] [--json FILE] [--write]

Three tables: the rasterizer's forward and adjoint with and without ``deterministic`` (CUDA events,
medians, taken in turns), a whole reconstruction of the demo melon likewise, and runs of the solver
with mixed speeds, which has no other mode.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import demo, ops
from gsfluent.figure.markdown import enter
from gsfluent.io import load_capture
from gsfluent.pipeline import Reconstruct

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "deterministic.md"
FIELDS = ("means", "quats", "scales", "opacities", "sh")
CUBE = 55_296  # points of each body in the solver's runs
DX = 0.02


def milliseconds(device: torch.device, work: Callable[[], Any]) -> float:
    """Time of one call: CUDA events, or the process's."""
    if device.type == "cpu":
        start = time.process_time()
        work()
        return 1e3 * (time.process_time() - start)
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    begin.record()
    work()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end)


def cloud(count: int, device: torch.device) -> dict[str, Tensor]:
    """A ball of splats that fills the picture, SH of degree 3, as leaves."""
    g = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    means = direction * torch.rand(count, 1, generator=g) ** (1 / 3)
    size = 0.5 * (4.19 / count) ** (1 / 3)
    values = {
        "means": means,
        "opacities": 0.02 + 0.96 * torch.rand(count, generator=g),
        "quats": torch.randn(count, 4, generator=g),
        "scales": size * (0.3 + torch.rand(count, 3, generator=g)),
        "sh": 0.3 * torch.randn(count, 16, 3, generator=g),
    }
    return {k: v.to(device).requires_grad_() for k, v in values.items()}


def raster(count: int, size: tuple[int, int], given: argparse.Namespace) -> dict[str, Any]:
    """Times of one frame and its adjoint in both modes, and how the gradients compare."""
    device = torch.device(given.device)
    leaves = cloud(count, device)
    width, height = size
    viewmat = torch.eye(4, device=device)
    viewmat[2, 3] = 2.5
    focal = 1.1 * height
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]], device=device)
    pull = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(1)).to(device)
    pull /= pull.numel()
    rest = {k: v for k, v in leaves.items() if k not in ("means", "opacities")}

    def frame(deterministic: bool) -> Tensor:
        return ops.rasterize(
            leaves["means"], leaves["opacities"], viewmat, K, width, height, **rest, depth=False,
            deterministic=deterministic,
        ).image  # fmt: skip

    def adjoint(image: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(image, list(leaves.values()), pull, retain_graph=True)

    found: dict[str, Any] = {"splats": count, "size": f"{width} x {height}"}
    images = {mode: frame(mode) for mode in (False, True)}
    first = {mode: adjoint(image) for mode, image in images.items()}  # also warms up
    times: dict[bool, list[float]] = {False: [], True: []}
    varied = {False: 0, True: 0}
    for _ in range(given.repeats):
        for mode, image in images.items():
            times[mode].append(milliseconds(device, partial(adjoint, image)))
    for _ in range(5):
        for mode, image in images.items():
            again = adjoint(image)
            varied[mode] += any(
                not torch.equal(a, b) for a, b in zip(again, first[mode], strict=True)
            )
    with torch.no_grad():
        forward = [milliseconds(device, lambda: frame(False)) for _ in range(given.repeats)]
    found["forward"] = statistics.median(forward)
    found["fast"], found["ordered"] = (statistics.median(times[mode]) for mode in (False, True))
    found["fast_varied"], found["ordered_varied"] = varied[False], varied[True]
    found["difference"] = max(
        float((a.double() - b.double()).norm() / b.double().norm())
        for a, b in zip(first[True], first[False], strict=True)
    )
    if device.type == "cuda":
        for mode, name in ((False, "fast_memory"), (True, "ordered_memory")):
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
            adjoint(images[mode])
            found[name] = (torch.cuda.max_memory_allocated() - before) / 2**20
    return found


def reconstruction(given: argparse.Namespace) -> dict[str, Any]:
    """Seconds of training in both modes, and whether two runs are one."""
    found: dict[str, Any] = {"views": given.views, "iterations": given.iterations}
    with tempfile.TemporaryDirectory() as folder:
        demo.make_capture("watermelon", Path(folder), views=given.views, size=given.photograph)
        capture = load_capture(Path(folder))
        for mode, name in ((False, "fast"), (True, "ordered")):
            runs = [
                Reconstruct(given.iterations, device=given.device, deterministic=mode)(capture)
                for _ in range(3)
            ]
            seconds = [run.report["train_seconds"] for run in runs[1:]]  # the first warms up
            found[name] = min(seconds)
            found[f"{name}_psnr"] = [run.report["psnr"] for run in runs]
            found[f"{name}_gaussians"] = [run.count for run in runs]
            found[f"{name}_same"] = all(
                getattr(run, field).shape == getattr(runs[0], field).shape
                and torch.equal(getattr(run, field), getattr(runs[0], field))
                for run in runs[1:]
                for field in FIELDS
            )
    return found


def cube(seed: int) -> Tensor:
    """Jittered points, eight per cell, float64 [CUBE, 3]."""
    side = math.ceil((CUBE / 8) ** (1 / 3))
    axis = (torch.arange(2 * side, dtype=torch.float64) + 0.5) * (0.5 * DX)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    noise = torch.rand(points.shape, generator=torch.Generator().manual_seed(seed)) - 0.5
    return (points + 0.3 * DX * noise.double())[:CUBE]


def solver(slow: float, given: argparse.Namespace) -> dict[str, Any]:
    """Points whose velocity has other bits in any of five runs, of 2 x 55 296."""
    device = torch.device(given.device)
    apart = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    position = torch.cat([cube(0), cube(1) + apart])
    n = len(position)
    velocity = 10.0 * slow * torch.randn(n, 3, generator=torch.Generator().manual_seed(2))
    velocity[:CUBE] = torch.tensor([0.0, 0.0, -10.0])
    young, poisson = 1e6, 0.3
    row = [young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson)), 0, 0, 0, 0, 1000.0, 0]
    arguments = {
        "position": position,
        "velocity": velocity,
        "mass": torch.full((n,), 1000.0 * DX**3 / 8),
        "volume": torch.full((n,), DX**3 / 8),
        "law": torch.zeros(1, dtype=torch.int32),
        "params": torch.tensor([row]),
        "body": (torch.arange(n) >= CUBE).to(torch.int32),
    }
    arguments = {k: v.to(device) for k, v in arguments.items()}
    runs = []
    for _ in range(5):
        one = ops.Solver(**arguments, dx=DX, gravity=(0.0, 0.0, 0.0))
        one.advance(steps=20)
        runs.append(one.velocity)
    differs = torch.zeros(n, dtype=torch.bool, device=device)
    for run in runs[1:]:
        differs |= (run != runs[0]).any(1)
    return {"slow": slow, "differs": int(differs.sum()), "points": n}


def head(*names: str) -> tuple[str, str]:
    """First lines of a table."""
    return f"| {' | '.join(names)} |", f"| {' | '.join('---' for _ in names)} |"


def lines(found: dict[str, Any]) -> Iterator[str]:
    """The tables."""
    yield f"{found['device']}, torch {found['torch']}; runs of five that gave other bits"
    yield ""
    yield from head(
        "splats", "picture", "forward [ms]", "adjoint, fast [ms]", "deterministic [ms]", "ratio",
        "memory [MiB]", "other bits, fast", "deterministic", "difference",
    )  # fmt: skip
    for row in found["raster"]:
        memory = "-"
        if "fast_memory" in row:
            memory = f"{row['fast_memory']:.0f}, {row['ordered_memory']:.0f}"
        yield (
            f"| {row['splats']} | {row['size']} | {row['forward']:.3f} | {row['fast']:.3f} | "
            f"{row['ordered']:.3f} | {row['ordered'] / row['fast']:.2f} | {memory} | "
            f"{row['fast_varied']} of 5 | {row['ordered_varied']} of 5 | {row['difference']:.1e} |"
        )
    r = found["reconstruction"]
    yield ""
    yield from head("reconstruction", "training [s]", "PSNR [dB]", "Gaussians", "the same bits")
    for name, title in (("fast", "fast"), ("ordered", "deterministic")):
        psnr = ", ".join(f"{p:.3f}" for p in r[f"{name}_psnr"])
        count = ", ".join(str(c) for c in r[f"{name}_gaussians"])
        same = "yes" if r[f"{name}_same"] else "no"
        yield f"| {title} | {r[name]:.2f} | {psnr} | {count} | {same} |"
    yield ""
    yield f"Ratio of the training: {r['ordered'] / r['fast']:.2f}."
    yield ""
    yield from head("speed of the slow body over the fast", "points with other bits in five runs")
    for row in found["solver"]:
        yield f"| {row['slow']:.0e} | {row['differs']} of {row['points']} |"


def main() -> int:
    """Measure, print, and enter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=["cpu", "cuda"])
    parser.add_argument("--splats", type=int, nargs="+", default=[100_000, 1_000_000])
    parser.add_argument("--size", default="1920x1080", help="picture [px]")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--photograph", type=int, default=320, help="of the melon [px]")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", action="store_true", help=f"enter the tables into {PAGE.name}")
    given = parser.parse_args()
    width, height = (int(n) for n in given.size.split("x"))
    sizes = [(width // 3, height // 3), (width, height)]
    on_gpu = given.device == "cuda"
    found = {
        "device": torch.cuda.get_device_name() if on_gpu else "CPU",
        "torch": torch.__version__,
        "raster": [raster(n, size, given) for n in given.splats for size in sizes],
        "reconstruction": reconstruction(given),
        "solver": [solver(10.0**-k, given) for k in range(3, 10)],
    }
    text = "\n".join(lines(found))
    sys.stdout.write(text + "\n")
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))
    if given.write:
        name = f"deterministic {given.device}"
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), name, text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
