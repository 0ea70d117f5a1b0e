"""Time gsfluent's rasterizer beside gsplat's, on the same Gaussians in one process.

python scripts/bench/gsplat/rasterizer.py --garden test_garden.npz \\
    --markdown docs/measured/benchmarks.md
python scripts/bench/gsplat/rasterizer.py --device cpu --threads 1 2  # gsfluent alone, 100 k

gsplat is imported when it is installed (its code is not part of gsfluent); without it gsfluent is
timed alone. Scenes: scenes.py. Forward under ``no_grad``; forward + backward of a
weighted sum of the image with gradients to means, quats, scales, opacities and SH. Times are
medians of CUDA events around one synchronised call (wall), and sums of the device time of its
kernels from torch.profiler (kernels). Memory is the peak above what was allocated before the call,
with all that the forward pass returned held until the gradients are there, as training loops do.
On the CPU: process and wall time, the least of the runs, and whether image and gradients have the
same bits for every number of threads.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from scenes import FAR, FIELDS, NEAR, Scene, garden_scene, random_scene
from tables import cpu_table, cuda_table
from torch import Tensor

from gsfluent import has_cuda, ops
from gsfluent.figure.markdown import enter

Renderer = Callable[[dict[str, Tensor], Scene], tuple[Tensor, Any]]

SIZES = {"100k": 100_000, "1M": 1_000_000, "4M": 4_000_000}
HEADING = "## The rasterizer beside gsplat"
IMAGES = {"800": (800, 800), "1080p": (1920, 1080)}


def gsfluent_renderer() -> Renderer:
    """Our forward pass without depth, as training calls it: the image, and all that it returns."""
    extra = {"depth": False} if "depth" in inspect.signature(ops.rasterize).parameters else {}

    def render(inputs: dict[str, Tensor], scene: Scene) -> tuple[Tensor, Any]:
        rendered = ops.rasterize(
            inputs["means"], inputs["opacities"], scene.viewmat, scene.K, scene.width, scene.height,
            quats=inputs["quats"], scales=inputs["scales"], sh=inputs["sh"],
            near=NEAR, far=FAR, **extra,
        )  # fmt: skip
        return rendered.image, rendered

    return render


def gsplat_renderer(packed: bool) -> Renderer | None:
    """gsplat's ``rasterization``, or None where it is not installed."""
    try:
        from gsplat import rasterization
    except ImportError:
        return None

    def render(inputs: dict[str, Tensor], scene: Scene) -> tuple[Tensor, Any]:
        returned = rasterization(
            inputs["means"], inputs["quats"], inputs["scales"], inputs["opacities"], inputs["sh"],
            scene.viewmat[None], scene.K[None], scene.width, scene.height,
            near_plane=NEAR, far_plane=FAR, sh_degree=3, packed=packed,
        )  # fmt: skip
        return returned[0][0], returned

    return render


def calls(
    render: Renderer, scene: Scene, keep: bool = True
) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """What is timed: the forward pass, and the forward and backward pass.

    Args:
        render: Of either rasterizer.
        scene: What is drawn.
        keep: Hold all that the forward pass returned until the backward pass has ended, as training
            loops do (densification reads it); else the image alone.
    """
    leaves = {name: value.clone().requires_grad_() for name, value in scene.inputs.items()}
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(scene.height, scene.width, 3, generator=g).to(scene.device)

    def forward() -> Tensor:
        with torch.no_grad():
            return render(leaves, scene)[0]

    def both() -> tuple[Tensor, ...]:
        image, returned = render(leaves, scene)
        if not keep:
            returned = None
        loss = (image * weights).sum()
        gradients = torch.autograd.grad(loss, list(leaves.values()))
        del returned
        return gradients

    return forward, both


def wall_ms(call: Callable[[], Any], runs: int) -> float:
    """Median time of one call between CUDA events, the device idle before it [ms]."""
    for _ in range(5):
        call()
    times = []
    for _ in range(runs):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        start.record()
        call()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def kernels(call: Callable[[], Any], runs: int) -> tuple[float, float, dict[str, float]]:
    """Device time of one call [ms], its launches, and the eight longest kernels [ms]."""
    from torch.autograd import DeviceType
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as trace:
        for _ in range(runs):
            call()
        torch.cuda.synchronize()
    rows = [e for e in trace.key_averages() if e.device_type == DeviceType.CUDA]
    rows.sort(key=lambda e: -e.self_device_time_total)
    total = sum(e.self_device_time_total for e in rows) / runs / 1e3
    longest: dict[str, float] = {}
    for e in rows:
        name = kernel_name(e.key)
        longest[name] = longest.get(name, 0.0) + e.self_device_time_total / runs / 1e3
    ranked = sorted(longest.items(), key=lambda item: -item[1])[:8]
    return total, sum(e.count for e in rows) / runs, dict(ranked)


def kernel_name(key: str) -> str:
    """The bare name of a demangled kernel: no return type, namespaces or template arguments."""
    depth, bare = 0, ""
    for letter in key.replace("(anonymous namespace)::", ""):
        if letter == "(" and depth == 0:
            break
        depth += (letter == "<") - (letter == ">")
        if depth == 0 and letter != ">":
            bare += letter
    return bare.strip().split("::")[-1].split(" ")[-1] or key[:60]


def peak_mib(call: Callable[[], Any]) -> float:
    """Most device memory that one call holds above what was there before it [MiB]."""
    torch.cuda.empty_cache()
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    call()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def measure(render: Renderer, scene: Scene) -> dict[str, Any]:
    """Times, kernel sums and memory of one renderer on one scene."""
    row: dict[str, Any] = {}
    for name, call, runs in zip(("fwd", "both"), calls(render, scene), (50, 30), strict=True):
        row[name] = wall_ms(call, runs)
        row[f"{name}_kernels"], row[f"{name}_launches"], row[f"{name}_longest"] = kernels(call, 10)
        row[f"{name}_mib"] = peak_mib(call)
    row["image_mib"] = peak_mib(calls(render, scene, keep=False)[1])
    return row


def decibels(image: Tensor, other: Tensor) -> float:
    """PSNR of the difference of two images with values around [0, 1]."""
    error = float((image.double() - other.double()).square().mean())
    return math.inf if error == 0 else -10.0 * math.log10(error)


def compare(ours: Renderer, theirs: Renderer, scene: Scene) -> dict[str, Any]:
    """PSNR of the difference, and the largest gradient difference over the largest gradient."""
    (forward, both), (forward2, both2) = calls(ours, scene), calls(theirs, scene)
    row: dict[str, Any] = {"difference_db": decibels(forward(), forward2())}
    for name, a, b in zip(FIELDS, both(), both2(), strict=True):
        row[f"gradient_{name}"] = float((a - b).abs().max() / b.abs().max().clamp_min(1e-30))
    return row


def bench_cuda(scene: Scene, label: str) -> dict[str, Any]:
    """One row: gsfluent, and gsplat packed and not."""
    row: dict[str, Any] = {
        "scene": label, "gaussians": scene.count,
        "width": scene.width, "height": scene.height,
    }  # fmt: skip
    ours = gsfluent_renderer()
    row["gsfluent"] = measure(ours, scene)
    for name, packed in (("packed", True), ("unpacked", False)):
        theirs = gsplat_renderer(packed)
        if theirs is not None:
            row[name] = measure(theirs, scene)
            row[name] |= compare(ours, theirs, scene)
    return row


def bench_cpu(scene: Scene, label: str, threads: list[int], runs: int) -> dict[str, Any]:
    """One row: gsfluent on each number of threads, and whether they agree to the bit."""
    row: dict[str, Any] = {
        "scene": label, "gaussians": scene.count,
        "width": scene.width, "height": scene.height, "threads": {}, "same_bits": True,
    }  # fmt: skip
    forward, both = calls(gsfluent_renderer(), scene)
    first: list[Tensor] | None = None
    for count in threads:
        torch.set_num_threads(count)
        entry = {}
        for name, call in (("fwd", forward), ("both", both)):
            call()
            times = []
            for _ in range(runs):
                wall, process = time.perf_counter(), time.process_time()
                call()
                times.append((time.perf_counter() - wall, time.process_time() - process))
            entry[f"{name}_wall"] = 1e3 * min(t[0] for t in times)
            entry[f"{name}_process"] = 1e3 * min(t[1] for t in times)
        result = [forward(), *both()]
        first = first or result
        row["same_bits"] &= all(torch.equal(a, b) for a, b in zip(first, result, strict=True))
        row["threads"][count] = entry
    return row


def scenes(options: argparse.Namespace, device: torch.device) -> Iterator[tuple[Scene, str]]:
    """What is to be timed and its label, each built when its turn comes."""
    for kind in options.scenes:
        for size in options.sizes if kind != "garden" else ["garden"]:
            for image in options.images:
                width, height = IMAGES[image]
                if kind != "garden":
                    scene = random_scene(kind, SIZES[size], width, height, device)
                    yield scene, f"{kind} {size}"
                elif options.garden is not None:
                    yield garden_scene(options.garden, width, height, device), "garden"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument("--scenes", nargs="+", choices=["nat", "heavy", "garden"],
                        default=["nat", "heavy", "garden"])  # fmt: skip
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), help="all; on the CPU 100k")
    parser.add_argument("--images", nargs="+", choices=list(IMAGES), help="both; on the CPU 800")
    parser.add_argument("--garden", type=Path, help="assets/test_garden.npz of a gsplat checkout")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], help="CPU only")
    parser.add_argument("--runs", type=int, default=5, help="CPU only")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args(arguments)
    if options.garden is not None and not options.garden.is_file():
        parser.error(f"--garden: {options.garden} does not exist")
    if options.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no GPU, or gsfluent was built without its CUDA kernels")
    if min(options.threads) < 1 or options.runs < 1:
        parser.error("--threads and --runs must be at least 1")
    gpu = options.device == "cuda" or (options.device == "auto" and has_cuda())
    options.sizes = options.sizes or (list(SIZES) if gpu else ["100k"])
    options.images = options.images or (list(IMAGES) if gpu else ["800"])
    rows = []
    for scene, label in scenes(options, torch.device("cuda" if gpu else "cpu")):
        if gpu:
            row = bench_cuda(scene, label)
            torch.cuda.empty_cache()
        else:
            row = bench_cpu(scene, label, options.threads, options.runs)
        rows.append(row)
        brief = {k: v for k, v in row.items() if not isinstance(v, dict)}
        for who in ("gsfluent", "packed", "unpacked"):
            for key, value in row.get(who, {}).items():
                if not isinstance(value, dict):
                    brief[f"{who}.{key}"] = float(f"{value:.4g}")
        sys.stderr.write(json.dumps(brief | {"threads": row.get("threads")}) + "\n")
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n")
    if gpu:
        text = cuda_table(torch.cuda.get_device_name(), rows, gsplat_version())
    else:
        text = cpu_table(platform.processor() or platform.machine(), rows)
    sys.stdout.write(text + "\n")
    if options.markdown:
        page = options.markdown
        part = "bench_gsplat" if gpu else "bench_gsplat cpu"
        old = page.read_text() if page.exists() else ""
        heading = "" if HEADING in old else HEADING
        page.write_text(enter(old, part, text, heading))
    return 0


def gsplat_version() -> str | None:
    """Version of the installed gsplat, None without one."""
    try:
        import gsplat
    except ImportError:
        return None
    return str(gsplat.__version__)


if __name__ == "__main__":
    sys.exit(main())
