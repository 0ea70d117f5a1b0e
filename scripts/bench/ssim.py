"""Time SSIM, the photometric loss and Adam beside plain torch on this machine; print markdown.

Plain torch: SSIM by separable depthwise convolutions (half the time of one 11 x 11 convolution),
Adam by ``torch.optim.Adam(foreach=True)``.

python scripts/bench/ssim.py                 # CPU, and the GPU when there is one
python scripts/bench/ssim.py --device cuda --page docs/measured/losses.md
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from gsfluent import has_cuda, ops
from gsfluent.figure.markdown import enter

SIZES = ((200, 200), (800, 800), (1080, 1920))
GAUSSIANS = {"cpu": 100_000, "cuda": 1_000_000}
COLUMNS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh": (16, 3)}


def milliseconds(run: Callable[[], object], device: str, seconds: float = 1.0) -> float:
    """Median of repeated runs: process time on the CPU, events on the GPU."""
    run()
    times: list[float] = []
    until = time.perf_counter() + seconds
    while len(times) < 3 or (time.perf_counter() < until and len(times) < 200):
        if device == "cuda":
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            run()
            end.record()
            end.synchronize()
            times.append(begin.elapsed_time(end))
        else:
            start = time.process_time()
            run()
            times.append(1e3 * (time.process_time() - start))
    return statistics.median(times)


def plain_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean over the windows inside the image, [H, W, C]."""
    channels = image.shape[2]
    offset = torch.arange(11.0, device=image.device) - 5.0
    line = torch.exp(-offset.square() / 4.5)
    across = (line / line.sum()).view(1, 1, 1, 11).repeat(channels, 1, 1, 1)
    x, y = (t.permute(2, 0, 1)[None] for t in (image, target))

    def blur(value: Tensor) -> Tensor:
        rows = conv2d(value, across, groups=channels)
        return conv2d(rows, across.transpose(2, 3), groups=channels)

    mean_x, mean_y = blur(x), blur(y)
    variances = blur(x * x + y * y) - mean_x.square() - mean_y.square()
    covariance = blur(x * y) - mean_x * mean_y
    above = (2.0 * mean_x * mean_y + 1e-4) * (2.0 * covariance + 9e-4)
    return (above / ((mean_x.square() + mean_y.square() + 1e-4) * (variances + 9e-4))).mean()


def plain_loss(image: Tensor, target: Tensor) -> Tensor:
    l1 = (image - target).abs().mean()
    return 0.8 * l1 + 0.2 * (1.0 - plain_ssim(image, target))


def loss_rows(device: str, size: tuple[int, int]) -> list[tuple[str, float, float]]:
    """Name, ours, plain torch [ms]; forward and backward."""
    generator = torch.Generator().manual_seed(0)
    image, target = (torch.rand(*size, 3, generator=generator).to(device) for _ in range(2))
    leaf = image.clone().requires_grad_()

    def both(loss: Callable[[], Tensor]) -> Callable[[], object]:
        return lambda: torch.autograd.grad(loss(), leaf)

    def pair(ours: Callable[[], Tensor], plain: Callable[[], Tensor]) -> tuple[float, float]:
        return milliseconds(both(ours), device), milliseconds(both(plain), device)

    text = f"{size[1]} x {size[0]} x 3"
    assert abs(ops.ssim(image, target).item() - plain_ssim(image, target).item()) < 1e-4
    forward = (lambda: ops.ssim(image, target)), (lambda: plain_ssim(image, target))
    return [
        (f"ssim, forward, {text}", *(milliseconds(f, device) for f in forward)),
        (
            f"ssim, forward + backward, {text}",
            *pair(lambda: ops.ssim(leaf, target), lambda: plain_ssim(leaf, target)),
        ),
        (
            f"photometric loss, forward + backward, {text}",
            *pair(
                lambda: ops.photometric_loss(leaf, target).loss,
                lambda: plain_loss(leaf, target),
            ),
        ),
    ]


def adam_rows(device: str, count: int) -> list[tuple[str, float, float]]:
    """One step over splats with SH of degree 3; then with a third of them in view."""
    groups = [[torch.rand(count, *c, device=device) for c in COLUMNS.values()] for _ in range(4)]
    visible = (torch.rand(count, device=device) < 1.0 / 3.0).int()
    leaves = [p.clone().requires_grad_() for p in groups[0]]
    for leaf, gradient in zip(leaves, groups[1], strict=True):
        leaf.grad = gradient
    plain = torch.optim.Adam(leaves, lr=1e-3, eps=1e-15, foreach=True)
    base = milliseconds(plain.step, device)
    rows = []
    for name, mark in (("all rows", None), ("a third visible", visible)):
        ours = milliseconds(
            lambda mark=mark: ops.adam_step(*groups, lr=1e-3, step=10, eps=1e-15, visible=mark),
            device,
        )
        rows.append((f"adam, {count // 1000} k splats of 59 values, {name}", ours, base))
    return rows


def main() -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"))
    parser.add_argument("--page", type=Path, help="enter the tables into this page")
    options = parser.parse_args()
    wanted = options.device
    if wanted == "cuda" and not has_cuda():
        parser.error("no GPU, or gsfluent was built without CUDA")
    devices = [wanted] if wanted else ["cpu", *(["cuda"] if has_cuda() else [])]
    for device in devices:
        name = torch.cuda.get_device_name() if device == "cuda" else platform.machine()
        threads = "" if device == "cuda" else f", {torch.get_num_threads()} thread(s), process time"
        lines = [f"{device}: {name}{threads}, torch {torch.__version__}, float32, median", ""]
        lines += ["| what | ours [ms] | plain torch [ms] | ratio |", "| --- | --- | --- | --- |"]
        print("\n".join(["", *lines]))
        rows = [row for size in SIZES for row in loss_rows(device, size)]
        for what, ours, plain in [*rows, *adam_rows(device, GAUSSIANS[device])]:
            lines.append(f"| {what} | {ours:.3f} | {plain:.3f} | {plain / ours:.1f} |")
            print(lines[-1], flush=True)
        if options.page is not None:
            page = options.page.read_text(encoding="utf-8")
            text = enter(page, f"ssim {device}", "\n".join(lines), f"## {device.upper()}")
            options.page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
