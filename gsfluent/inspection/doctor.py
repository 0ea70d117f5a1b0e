"""What works on this machine: versions, compiled ops, memory, GPUs, a small test of every op.

Each test has an answer known without a second implementation (mass is conserved, a rest state stays
at rest, one opaque splat shows its own colour), so a wrong build, not only a missing one, is found
in about a second.
"""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import shutil
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import gsfluent
from gsfluent import ops
from gsfluent._load import NO_CUDA_KERNELS
from gsfluent.errors import EXTRAS
from gsfluent.ops._memory import available_memory

_LIBRARIES = (
    "numpy",
    "scipy",
    "pillow",
    "trimesh",
    "opencv-python-headless",
    "imageio-ffmpeg",
    "diffusers",
)


def examine(device: torch.device, *, every_device: bool = True) -> dict[str, Any]:
    """Describe the machine and test the ops.

    Args:
        device: Where to test.
        every_device: Test the CPU as well when ``device`` is a GPU.

    Returns:
        Plain values for JSON; ``ok`` is False when an op is missing or gives a wrong answer.
    """
    devices = [torch.device("cpu")] if every_device or device.type == "cpu" else []
    if device.type == "cuda":
        devices.append(device)
    tests = [run_test(name, d) for d in devices for name in TESTS]
    return {
        "ok": all(test["ok"] for test in tests),
        "gsfluent": gsfluent.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "torch": torch.__version__,
        "torch_cuda": torch.version.cuda,
        "cpu": {
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "capability": torch.backends.cpu.get_cpu_capability(),
            "memory_bytes": _physical_memory(),
            "memory_available_bytes": available_memory(),
        },
        "disk_free_bytes": shutil.disk_usage(".").free,
        "cuda_library": NO_CUDA_KERNELS or "loaded",
        "gpus": [_describe_gpu(i) for i in range(torch.cuda.device_count())],
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "extras": {extra: {name: _version(name) for name in EXTRAS[extra]} for extra in EXTRAS},
        "ops": {name: compiled_for(name) for name in registered_ops()},
        "self_test": tests,
    }


def registered_ops() -> list[str]:
    """Names of all operators in the ``gsfluent`` namespace."""
    names = torch._C._dispatch_get_all_op_names()
    found = {n.split("::")[1].split(".")[0] for n in names if n.startswith("gsfluent::")}
    return sorted(found)


def compiled_for(name: str) -> list[str]:
    """Back ends that have a kernel for operator ``name``."""
    has = torch._C._dispatch_has_kernel_for_dispatch_key
    return [key.lower() for key in ("CPU", "CUDA") if has(f"gsfluent::{name}", key)]


def run_test(name: str, device: torch.device) -> dict[str, Any]:
    """Run one self-test; a failure is an entry in the table, not an exception."""
    start = time.perf_counter()
    try:
        error = TESTS[name](device)
        ok, note = error <= 1e-4, f"relative error {error:.1e}"
    except Exception as failure:  # the doctor's task is to report it
        ok, note = False, f"{type(failure).__name__}: {failure}"
    seconds = round(time.perf_counter() - start, 4)
    return {"op": name, "device": str(device), "ok": ok, "seconds": seconds, "note": note}


def _worst(*errors: float) -> float:
    """The largest error; NaN, which ``max`` would let pass, counts as infinite."""
    return max(error if math.isfinite(error) else math.inf for error in errors)


def _cloud(device: torch.device) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    position = 0.3 + 0.4 * torch.rand(500, 3, generator=generator)
    mass = 0.5 + torch.rand(500, generator=generator)
    return position.to(device), mass.to(device)


_DX = 0.05


def _moving_grid(device: torch.device) -> tuple[Tensor, Tensor, Tensor, ops.Blocks, Tensor]:
    position, mass = _cloud(device)
    velocity = torch.tensor([1.0, -2.0, 0.5], device=device).expand(500, 3).contiguous()
    affine = torch.zeros(500, 3, 3, device=device)
    blocks = ops.build_blocks(position, _DX)
    grid, _ = ops.p2g(position, velocity, affine, mass, dx=_DX, blocks=blocks)
    return position, velocity, mass, blocks, grid


def _test_p2g(device: torch.device) -> float:
    """Mass and momentum on the grid are those of the points."""
    _, velocity, mass, _, grid = _moving_grid(device)
    total = grid.sum(dim=(0, 1, 2))
    momentum = (mass[:, None] * velocity).sum(0)
    scale = float(mass.sum())
    return _worst(
        abs(float(total[3] - mass.sum())) / scale,
        float((total[:3] - momentum).abs().amax()) / scale,
    )


def _test_grid_update(device: torch.device) -> float:
    """Under gravity alone every node with mass gains dt g."""
    _, velocity, _, blocks, grid = _moving_grid(device)
    after, _, _ = ops.grid_update(grid, dx=_DX, dt=0.01, blocks=blocks, gravity=(0.0, 0.0, -10.0))
    massive = grid[..., 3] > 1e-3
    expected = velocity[0] + velocity.new_tensor([0.0, 0.0, -0.1])
    return _worst(float((after[massive] - expected).abs().amax()) / 2.0)


def _test_g2p(device: torch.device) -> float:
    """A uniform field comes back as the same velocity and no affine part."""
    position, velocity, _, blocks, grid = _moving_grid(device)
    field, _, _ = ops.grid_update(grid, dx=_DX, dt=1e-3, blocks=blocks, gravity=(0.0, 0.0, 0.0))
    moved, gathered, affine, _ = ops.g2p(field, position, dx=_DX, dt=1e-3, blocks=blocks)
    errors = (gathered - velocity, affine * _DX, (moved - position - 1e-3 * velocity) * 1e3)
    return _worst(*(float(e.abs().amax()) / 2.0 for e in errors))


def _test_return_mapping(device: torch.device) -> float:
    """Rest stays at rest without stress; a small shear gives tau = 2 mu eps and no plastic flow."""
    mu, kappa, shear = 1.0e4, 3.0e4, 1.0e-4
    strain = torch.zeros(2, 6, device=device)
    increment = torch.zeros(2, 3, 3, device=device)
    increment[1, 0, 1] = increment[1, 1, 0] = shear
    law = torch.tensor([1], dtype=torch.int32, device=device)
    params = torch.tensor([[mu, kappa, 2.36, 0.6, 3.0, 0.0, 1000.0, 0.0]], device=device)
    alpha = torch.full((2,), -0.04, device=device)
    _, after, stress, _ = ops.return_mapping(strain, alpha, increment, law=law, params=params)
    rest = float(stress[0].abs().amax()) / mu
    # second order in the shear: the relative error of the linear answer is of the order of the
    # shear itself
    linear = abs(float(stress[1, 3]) / (2.0 * mu * shear) - 1.0)
    return _worst(rest, linear * 0.1, float((after - alpha).abs().amax()))


def _test_rasterize(device: torch.device) -> float:
    """A wide opaque splat shows its colour, opacity and depth in the middle of the picture."""
    color = torch.tensor([[0.2, 0.5, 0.8]], device=device)
    focal = torch.tensor([[32.0, 0.0, 16.0], [0.0, 32.0, 16.0], [0.0, 0.0, 1.0]], device=device)
    seen = ops.rasterize(
        torch.tensor([[0.0, 0.0, 2.0]], device=device),
        torch.tensor([0.9], device=device),
        torch.eye(4, device=device),
        focal,
        32,
        32,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
        scales=torch.full((1, 3), 50.0, device=device),
        colors=color,
    )
    errors = (
        seen.image[16, 16] - 0.9 * color[0],
        seen.alpha[16, 16] - 0.9,
        seen.depth[16, 16] - 2.0,
    )
    # the pixel centre is half a pixel off the splat's, 1e-8 of its width
    return _worst(*(float(e.abs().amax()) for e in errors))


def _test_mvee(device: torch.device) -> float:
    """Corners of a box lie on an ellipsoid of semi-axes sqrt(3) times the half edges."""
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    half = torch.tensor([1.0, 2.0, 0.5])
    center, shape = ops.mvee((signs * half + 3.0)[None].to(device), tolerance=1e-5)
    expected = torch.diag(3.0 * half**2).to(device)
    wrong_center = float((center[0] - 3.0).abs().amax())
    # Khachiyan stops at the tolerance; 1e-4 of the doctor's own bar is left after this factor
    return _worst(wrong_center, 0.1 * float((shape[0] - expected).abs().amax()) / 12.0)


def _test_photometric_loss(device: torch.device) -> float:
    """Equal images have loss 0; flat ones a known similarity and, without it, slope 1 per value."""
    picture = torch.rand(24, 20, 3, generator=torch.Generator().manual_seed(0)).to(device)
    same = ops.photometric_loss(picture, picture)
    a, b = 0.6, 0.2
    flat = torch.full((16, 12, 3), a, device=device, requires_grad=True)
    apart = ops.photometric_loss(flat, torch.full_like(flat, b, requires_grad=False))
    (slope,) = torch.autograd.grad(apart.loss, flat)
    luminance = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    # d luminance / da, spread over all values by windows that sum to 1
    steep = 2 * b / (a * a + b * b + 1e-4) - 2 * a * luminance / (a * a + b * b + 1e-4)
    total = 0.8 - 0.2 * steep
    # the variance of flat float32 windows, 1e-8, stands beside 9e-4
    return _worst(
        float(same.loss.abs()),
        float((apart.l1.detach() - (a - b)).abs()),
        0.1 * abs(float(apart.ssim) - luminance),
        0.1 * abs(float(slope.sum()) - total),
    )


def _test_adam_step(device: torch.device) -> float:
    """The first step is the rate times the sign of the gradient; rows not seen stay."""
    value, first, second = (torch.zeros(3, 2, device=device) for _ in range(3))
    gradient = torch.tensor([[1e-3, -4.0], [5.0, 2e4], [-1.0, 1.0]], device=device)
    visible = torch.tensor([True, True, False], device=device)
    ops.adam_step([value], [gradient], [first], [second], lr=0.5, step=1, eps=0.0, visible=visible)
    expected = -0.5 * gradient.sign() * visible[:, None]
    return _worst(float((value - expected).abs().amax()))


TESTS: dict[str, Callable[[torch.device], float]] = {
    "p2g": _test_p2g,
    "grid_update": _test_grid_update,
    "g2p": _test_g2p,
    "return_mapping": _test_return_mapping,
    "rasterize": _test_rasterize,
    "mvee": _test_mvee,
    "photometric_loss": _test_photometric_loss,
    "adam_step": _test_adam_step,
}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _physical_memory() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _describe_gpu(index: int) -> dict[str, Any]:
    properties = torch.cuda.get_device_properties(index)
    free, total = torch.cuda.mem_get_info(index)
    return {
        "name": properties.name,
        "capability": f"{properties.major}.{properties.minor}",
        "memory_bytes": total,
        "memory_free_bytes": free,
    }
