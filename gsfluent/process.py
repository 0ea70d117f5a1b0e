"""Processes that are alive, and since when; the running kernel; what is done beside the work."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_SLACK = 2.0  # [s]: the kernel counts in ticks since a boot that it knows to the second


@contextmanager
def repeated(seconds: float, act: Callable[[], None]) -> Iterator[None]:
    """Call a function each so many seconds, in a thread, while the block runs."""
    over = threading.Event()

    def live() -> None:
        while not over.wait(seconds):
            act()

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def is_alive(pid: int, since: float) -> bool:
    """Whether the process that had a number at a time [s since 1970] has it still.

    Numbers are given again: a process that began after ``since`` is another one. Where a system
    does not tell when a process began, any process of that number counts.
    """
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # it is there, and somebody else's
    begun = _begun(pid)
    return begun is None or begun <= since + _SLACK


def _begun(pid: int) -> float | None:
    """When a process began [s since 1970], where /proc says so; infinity for one that has ended."""
    try:
        # the name in brackets may hold spaces and brackets
        after = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        if after[0] in "ZX":  # only its parent has not taken note yet
            return math.inf
        boot = Path("/proc/stat").read_text(encoding="utf-8").partition("btime ")[2].split()[0]
        return int(boot) + int(after[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


def boot() -> str:
    """A name of the running kernel; empty where there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
