"""Who is at work on a task: a file that appears whole, is kept fresh, and outlives nobody for long.

A claim saves work and decides nothing: two that are at work on one task cost time, and the rename
of :meth:`gsfluent.sweep.folder.SweepFolder.finish` still lets only one of them through.
"""

from __future__ import annotations

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
        for _ in range(3):
            try:
                os.link(part, path)  # fails where there is one, on network file systems too
                return True
            except FileExistsError:
                seen = read_words(path)
                if not is_stale(path, part.stat().st_mtime):
                    return False
                _set_aside(path, seen)
        return False
    finally:
        part.unlink(missing_ok=True)


def _set_aside(path: Path, seen: dict[str, Any] | None) -> None:
    """Remove a stale claim, and none that another has made in its place meanwhile."""
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    with suppress(FileNotFoundError):
        path.rename(aside)
        if read_words(aside) != seen:
            with suppress(FileExistsError):
                os.link(aside, path)
        aside.unlink()


def _beat(path: Path, over: threading.Event) -> None:
    while not over.wait(BEAT):
        with suppress(OSError):
            os.utime(path)
