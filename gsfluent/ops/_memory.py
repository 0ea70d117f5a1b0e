"""How much memory there is, and what :func:`gsfluent.ops.rasterize` needs of it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_OP = "rasterize"
# Below this nobody asks the system what is left.
_SMALL = 1 << 28
# Per (camera, Gaussian) beside its row: radius, list of tiles, depth, box, sort keys.
_PER_SPLAT = 40
_ROW_HEADER = 10


class Arguments(NamedTuple):
    """The arguments of the operator in the order of its schema."""

    means: Tensor
    opacities: Tensor
    viewmat: Tensor
    K: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    sh: Tensor | None
    colors: Tensor | None
    background: Tensor | None
    normals: Tensor | None
    groups: Tensor | None
    means2d_offset: Tensor | None
    means2d_absgrad: Tensor | None
    width: int
    height: int
    antialiased: bool
    contribution: bool
    depth: bool
    median_depth: bool
    near: float
    far: float
    deterministic: bool


def available_memory() -> int | None:
    """Bytes of main memory that can still be used; None where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        return None
    return None


def required_bytes(a: Arguments) -> int:
    """Least memory that a call of the operator takes beside its inputs, with their gradients.

    The (splat, tile) pairs, whose number is only known later, are not in it.
    """
    cameras = a.viewmat.shape[0] if a.viewmat.dim() == 3 else 1
    splats = cameras * a.means.shape[0]
    channels = a.colors.shape[1] if a.colors is not None else 3
    features = channels + (3 if a.normals is not None else 0) + int(a.depth)
    size = a.means.element_size()
    pixels = cameras * a.width * a.height * size * (features + 1 + int(a.median_depth))
    gradients = 0
    if torch.is_grad_enabled():
        gradients = sum(
            t.numel() * t.element_size() for t in a if isinstance(t, Tensor) and t.requires_grad
        )
    return int(splats * ((_ROW_HEADER + features) * size + _PER_SPLAT) + pixels + gradients)


def refuse_if_too_large(a: Arguments) -> None:
    """Raise MemoryError, before anything is allocated, for a scene that main memory cannot hold."""
    need = required_bytes(a)
    if need < _SMALL:
        return
    there = available_memory()
    if there is not None and need > there:
        raise MemoryError(f"{shortage(a)}, {there} bytes are available")


def refuse_pairs(pairs: int, numbers: int, size: int) -> None:
    """Raise MemoryError when the sums of all (splat, tile) pairs do not fit in main memory."""
    need = pairs * numbers * size
    if need < _SMALL:
        return
    there = available_memory()
    if there is not None and need > there:
        raise MemoryError(
            f"{_OP}: the gradients of {pairs} (splat, tile) pairs need {need} bytes, {there} bytes "
            "are available; render a smaller image or fewer cameras at once"
        )


def shortage(a: Arguments) -> str:
    """The sentence that says what a call needs."""
    cameras = a.viewmat.shape[0] if a.viewmat.dim() == 3 else 1
    need = required_bytes(a)
    return (
        f"{_OP}: {a.means.shape[0]} Gaussians in {cameras} images of {a.width} x {a.height} px "
        f"need at least {need} bytes ({need / 2**30:.1f} GiB) on {a.means.device}"
    )


def is_shortage(error: BaseException) -> bool:
    """True when the allocator refused (torch's stable ABI reports only the call that failed)."""
    text = str(error)
    return isinstance(error, torch.OutOfMemoryError) or (
        "API call failed" in text
        and any(name in text for name in ("new_empty", "new_zeros", "contiguous"))
    )


def shortage_error(device: torch.device) -> type[Exception]:
    """What is raised when memory runs out on ``device``."""
    return MemoryError if device.type == "cpu" else torch.OutOfMemoryError
