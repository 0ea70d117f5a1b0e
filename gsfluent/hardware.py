"""Names of the hardware that figures are recorded with."""

from __future__ import annotations

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
