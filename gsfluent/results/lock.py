"""One run at a time in a result folder.

The lock is ``OUT/run.lock``. The kernel holds it (``flock``) and frees it when the process ends,
however it ends; its words name the process, the machine and the time. Where a file system cannot
hold locks, and for other machines, the words alone decide.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsfluent.errors import RunError
from gsfluent.io.atomic import remove_partials
from gsfluent.process import boot, is_alive

_log = logging.getLogger(__name__)
LOCK = "run.lock"
"""Its name in the result folder."""
_WAIT = "wait for it to end, or name another folder"


@contextmanager
def locked(out: Path, *, unlock: bool = False) -> Iterator[None]:
    """Hold a result folder while the block runs; it is made when missing.

    What dead runs have left half-written in it is removed first.

    Args:
        out: The folder.
        unlock: Take it although a run on another machine has not given it back.

    Raises:
        RunError: Another run holds it; nothing has been touched.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / LOCK
    handle, sure = _open(path)
    try:
        _take(handle, path, sure=sure, unlock=unlock)
    except BaseException:
        os.close(handle)
        raise
    try:
        for gone in remove_partials(out):
            _log.info("removed %s, half-written by a run that was stopped", gone)
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # while it is held: who waits for it finds it gone, and makes a new one
        os.close(handle)


def _open(path: Path) -> tuple[int, bool]:
    """The lock, and whether the kernel holds it for this process: some file systems cannot.

    Raises:
        RunError: Another process holds it.
    """
    while True:
        handle, sure = os.open(path, os.O_RDWR | os.O_CREAT, 0o644), True
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                words = _words(handle)
                os.close(handle)
                raise _held(path, words, _WAIT) from None
            sure = False
        with suppress(FileNotFoundError):
            if os.fstat(handle).st_ino == path.stat().st_ino:
                return handle, sure
        os.close(handle)  # its holder has just removed it


def _take(handle: int, path: Path, *, sure: bool, unlock: bool) -> None:
    """Read what the last holder has left, and write down the new one.

    Raises:
        RunError: The last holder may be alive.
    """
    words, host, kernel = _words(handle), socket.gethostname(), boot()
    if words:
        # a container has a host name of its own, and the kernel of its host
        if host != words.get("host") and (not kernel or kernel != words.get("boot")):
            if not unlock:
                hint = f"if that run has ended, say --unlock, or remove {path}"
                raise _held(path, words, hint)
        elif not sure and _lives(words):
            raise _held(path, words, _WAIT)
        _log.warning("%s: taken over from %s, which has ended without a word", path, _who(words))
    now = time.time()
    started = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(now))
    mine = {
        "process": os.getpid(),
        "host": host,
        "started": started,
        "seconds": now,
        "boot": kernel,
    }
    os.ftruncate(handle, 0)
    os.pwrite(handle, (json.dumps(mine) + "\n").encode(), 0)
    os.fsync(handle)


def _lives(words: dict[str, Any]) -> bool:
    try:
        return is_alive(int(words["process"]), float(words["seconds"]))
    except (KeyError, TypeError, ValueError):
        return False


def _words(handle: int) -> dict[str, Any]:
    """What a lock says; nothing for one that says nothing."""
    try:
        values = json.loads(os.pread(handle, 4096, 0))
    except ValueError:
        return {}
    return values if isinstance(values, dict) else {}


def _who(words: dict[str, Any]) -> str:
    process, host, started = (words.get(key, "?") for key in ("process", "host", "started"))
    return f"process {process} on {host}, started {started}"


def _held(path: Path, words: dict[str, Any], hint: str) -> RunError:
    what = f"{path.parent}: another run is at work there ({_who(words)})"
    return RunError(what, "everything; nothing was touched", hint)
