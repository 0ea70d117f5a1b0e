"""Names of hardware, for records; parts of a GPU, for processes that share it."""

from __future__ import annotations

import dataclasses
import os
import platform
import time
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


@dataclasses.dataclass(frozen=True)
class Load:
    """What the processors have done up to a moment [s]; nothing where the system does not say."""

    at: float
    busy: float | None  # CPU seconds of all processes of the machine
    own: float  # Of this one and of those that it has waited for

    @classmethod
    def now(cls) -> Load:
        """Of this moment."""
        own = sum(os.times()[:4])
        try:
            words = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
            user, nice, system, _, _, irq, soft, stolen = (float(word) for word in words[1:9])
        except (OSError, ValueError):
            return cls(time.perf_counter(), None, own)
        busy = (user + nice + system + irq + soft + stolen) / os.sysconf("SC_CLK_TCK")
        return cls(time.perf_counter(), busy, own)

    def crowded_since(self, now: Load | None = None) -> bool:
        """Whether others have left this process too few processors since then.

        Args:
            now: The end of that time; this moment if absent.
        """
        import torch

        now = now or Load.now()
        took = now.at - self.at
        if self.busy is None or now.busy is None or took <= 0.0:
            return False
        others = max(now.busy - self.busy - (now.own - self.own), 0.0) / took
        cores = os.cpu_count() or 1
        return cores - others < 0.9 * min(torch.get_num_threads(), cores)
