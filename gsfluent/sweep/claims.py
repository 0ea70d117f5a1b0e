"""Who is at work on a task: a file that appears whole, is kept fresh, and outlives nobody for long.

A claim saves work and decides nothing: two that are at work on one task cost time, and the rename
of :meth:`gsfluent.sweep.folder.SweepFolder.finish` still lets only one of them through.
"""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from gsfluent.process import boot, is_alive, repeated

BEAT = 10.0
"""Seconds from one sign of life to the next."""
SILENCE = 120.0
"""Seconds without one after which a claim is nobody's."""


def myself() -> dict[str, Any]:
    """This process, in words that others can judge."""
    return {
        "process": os.getpid(),
        "host": socket.gethostname(),
        "boot": boot(),
        "seconds": time.time(),
    }


def has_ended(words: dict[str, Any]) -> bool:
    """Whether a process has surely ended; of other machines nobody knows."""
    if words.get("host") != socket.gethostname() or not words.get("boot"):
        return False
    if words["boot"] != boot():
        return True  # this machine has started again since
    try:
        return not is_alive(int(words["process"]), float(words["seconds"]))
    except (KeyError, TypeError, ValueError):
        return False


def read_words(path: Path) -> dict[str, Any] | None:
    """A small JSON object; None where there is no whole one."""
    try:
        words = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return words if isinstance(words, dict) else None


def write_words(path: Path, words: dict[str, Any]) -> None:
    """Write a JSON object and make sure that it is on the disk."""
    with path.open("w", encoding="utf-8") as stream:
        json.dump(words, stream)
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Hold a claim while the block runs.

    Args:
        path: The file.

    Returns:
        Whether it is ours; if not, somebody else is at work, and the block should do nothing.
    """
    mine = myself() | {"token": secrets.token_hex(4)}
    if not _take(path, mine):
        yield False
        return
    try:
        with beating(lambda: os.utime(path)):
            yield True
    finally:
        if read_words(path) == mine:  # who was silent for too long has lost it
            path.unlink(missing_ok=True)


def beating(beat: Callable[[], None]) -> AbstractContextManager[None]:
    """Give signs of life while the block runs."""

    def once() -> None:
        with suppress(OSError):
            beat()

    return repeated(BEAT, once)


def is_stale(path: Path, now: float) -> bool:
    """Whether nobody holds a claim any more.

    Args:
        path: The file.
        now: The time by the clock of the file system [s].
    """
    try:
        heard = path.stat().st_mtime
    except FileNotFoundError:
        return True
    return now - heard > SILENCE or has_ended(read_words(path) or {})


def _take(path: Path, mine: dict[str, Any]) -> bool:
    part = path.with_name(f".{path.name}.{mine['token']}")
    write_words(part, mine)
    try:
        if _linked(part, path):
            return True
        with _alone(path.parent):
            if not is_stale(path, part.stat().st_mtime):
                return False
            path.unlink(missing_ok=True)
            return _linked(part, path)
    finally:
        part.unlink(missing_ok=True)


def _linked(part: Path, path: Path) -> bool:
    """Whether a claim could be made: a link fails where there is one, on network systems too."""
    try:
        os.link(part, path)
    except FileExistsError:
        return False
    return True


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Let one process at a time retake claims, where the file system has locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
