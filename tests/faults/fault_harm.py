"""What is done to runs: bits flipped, processes killed, two started at once, disks filled."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def flip(path: Path, place: int) -> None:
    """Flip one bit of a file; ``place`` counts its bits."""
    data = bytearray(path.read_bytes())
    data[place // 8] ^= 1 << place % 8
    path.write_bytes(bytes(data))


def flips(source: Path, names: list[str], count: int) -> list[tuple[str, int]]:
    """As many bits of every file."""
    chance = random.Random(0)
    sizes = {name: 8 * (source / name).stat().st_size for name in names}
    return [(name, chance.randrange(size)) for name, size in sizes.items() for _ in range(count)]


def child_of(work: Callable[[], int]) -> int:
    """Begin something in a process of its own; returns its number."""
    child = os.fork()
    if child == 0:
        code = 9
        try:
            code = work()
        finally:
            os._exit(code)
    return child


def in_child(work: Callable[[], int]) -> int:
    """Do something in a process of its own; returns what :func:`os.waitpid` says of its end."""
    return os.waitpid(child_of(work), 0)[1]


def at_once(work: Callable[[], int], count: int, gate: Path) -> list[int]:
    """Exit codes of processes that begin at the same moment; ``gate`` is a file not there yet."""

    def wait() -> int:
        while not gate.exists():
            time.sleep(0.001)
        return work()

    children = [child_of(wait) for _ in range(count)]
    gate.touch()
    ends = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    gate.unlink()
    return ends


def die_at(count: int, *, before: bool) -> None:
    """From now on this process is killed at its n-th file, before or after it gets its name."""
    rename, seen = os.replace, 0

    def dying(source: Any, target: Any) -> None:
        nonlocal seen
        seen += 1
        if seen == count and before:
            os.kill(os.getpid(), signal.SIGKILL)
        rename(source, target)
        if seen == count:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = dying


def die_after(seconds: float) -> None:
    """This process is killed when it has used so much time of a core, whatever it does then."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, seconds)


@contextmanager
def little_room(size: int) -> Iterator[None]:
    """No file may grow beyond a size: the system itself refuses the write, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class NoDisk(Exception):
    """No file system can be made here."""


@contextmanager
def disk_of(folder: Path, size: int) -> Iterator[Callable[[int], None]]:
    """A file system of its own of ``size`` bytes in a folder; yields what gives it another size.

    Raises:
        NoDisk: Only root can make one.
    """
    folder.mkdir()
    if os.geteuid() != 0 or shutil.which("mount") is None:
        raise NoDisk("only root can make a file system")
    made = _mount(f"size={size}", folder)
    if made.returncode:
        raise NoDisk(made.stderr.strip())
    try:
        yield lambda size: _mount(f"remount,size={size}", folder).check_returncode()
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def _mount(options: str, folder: Path) -> subprocess.CompletedProcess[str]:
    words = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    return subprocess.run(words, capture_output=True, text=True, check=False)
