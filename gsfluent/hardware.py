"""Names of hardware, for records; parts of a GPU, for processes that share it."""

from __future__ import annotations

import os
import platform
from pathlib import Path


def processor() -> str:
    """Name of the processor, as the system knows it."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""  # no such file on this system: the plain name stays
    names = [s.split(":", 1)[1].strip() for s in text.splitlines() if s.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


CONTEXT = 0.6e9
"""Bytes of a GPU that a process takes before its first tensor."""


def graphics_cards() -> list[str]:
    """The GPUs that processes may use, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [word for name in named.split(",") if (word := name.strip())]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]


def part_of_gpu(used: float, total: float) -> float:
    """Part of a GPU for a process, in eighths.

    Plans and peaks leave out what an allocator holds in reserve: a process gets twice as much.

    Args:
        used: Bytes that its tensors take.
        total: Bytes of the GPU.
    """
    eighths = -int(-8.0 * (2.0 * used + CONTEXT) // total)
    return min(max(eighths, 1), 8) / 8.0


def bound_memory(part: float) -> None:
    """Let this process take no more than a part of its GPU: beyond it, it is out of memory."""
    import torch

    if torch.cuda.is_available():
        total = float(torch.cuda.get_device_properties(0).total_memory)
        tensors = max(part - CONTEXT / total, 0.5 * part)
        torch.cuda.set_per_process_memory_fraction(tensors, 0)
