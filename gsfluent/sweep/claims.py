"""Who is at work on a task: a file that appears whole, is kept fresh, and outlives nobody for long.

A claim saves work and decides nothing: two that are at work on one task cost time, and the rename
of :meth:`gsfluent.sweep.folder.SweepFolder.finish` still lets only one of them through.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsfluent.sweep.folder import has_ended, myself, read_words, write_words

BEAT = 10.0
"""Seconds from one sign of life to the next."""
SILENCE = 120.0
"""Seconds without one after which a claim is nobody's."""


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
    over = threading.Event()
    thread = threading.Thread(target=_beat, args=(path, over), daemon=True)
    thread.start()
    try:
        yield True
    finally:
        over.set()
        thread.join()
        if read_words(path) == mine:  # who was silent for too long has lost it
            path.unlink(missing_ok=True)


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


def _beat(path: Path, over: threading.Event) -> None:
    while not over.wait(BEAT):
        with suppress(OSError):
            os.utime(path)
