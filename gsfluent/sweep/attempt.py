"""One try at a task, in whatever process: claimed, done apart, published by one rename."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsfluent.errors import GsfluentError
from gsfluent.sweep.bucket import opened
from gsfluent.sweep.folder import LOG, last_lines

DONE, HELD, FAILED = "done", "held", "failed"
"""How a try ends: the task is done, another is at work on it, or it went wrong and is noted."""

Function = Callable[[Any, Path], Any]
"""``function(item, folder)``: files go into the folder, what it returns is JSON."""

_PASSING = (errno.EAGAIN, errno.EIO, errno.ENOMEM, errno.ESTALE, errno.ETIMEDOUT)


def attempt(root: str | Path, name: str, function: Function, item: Any) -> str:
    """Try a task, unless it is done or somebody else's.

    Args:
        root: Folder of the sweep, or its store.
        name: Of the task.
        function: What it does.
        item: Given to it.

    Returns:
        ``DONE``, ``HELD`` or ``FAILED``.

    Raises:
        OSError: Not even the failure could be written down.
    """
    place = opened(root)
    with place.held(name) as ours:
        # after the claim: whoever held it before may have finished
        if place.is_done(name):
            return DONE
        if not ours:
            return HELD
        start, tries = time.time(), len(place.failures(name).get(name, ()))
        folder = place.begin(name)
        try:
            with _spoken_into(folder / LOG):
                value = function(item, folder)
            row = {"id": name, "value": value, "tries": tries + 1, "host": socket.gethostname()}
            row |= {"process": os.getpid(), "began": start, "seconds": time.time() - start}
            place.finish(name, folder, row)
            return DONE
        except Exception as error:
            place.fail(name, _record(error, folder))
            shutil.rmtree(folder, ignore_errors=True)
            return FAILED


def is_passing(error: BaseException) -> bool:
    """Whether an error is of the moment: another try may find more memory or a better network.

    A fault of a GPU may be another's: under NVIDIA's MPS a process that is ended in the middle of
    its work takes all on its GPU with it.
    """
    if type(error).__name__ == "AcceleratorError":  # torch's, see wants_memory
        return True
    if isinstance(error, OSError) and error.errno in _PASSING:
        return True
    if error.__cause__ is not None and is_passing(error.__cause__):
        return True
    return wants_memory(error) or isinstance(error, ConnectionError | TimeoutError)


def wants_memory(error: BaseException) -> bool:
    """Whether an error, or what it comes from, is of memory: of the machine or of its GPU."""
    name = type(error).__name__  # torch's class costs its import to name
    if name == "OutOfMemoryError" or isinstance(error, MemoryError):
        return True
    return error.__cause__ is not None and wants_memory(error.__cause__)


def _record(error: Exception, folder: Path) -> dict[str, Any]:
    said = last_lines(folder)
    if not isinstance(error, GsfluentError):  # whose words say all that a user can mend
        said += traceback.format_exception(error)[-1 - _FRAMES :]
    return {
        "kind": type(error).__name__,
        "message": str(error),
        "again": is_passing(error),
        "memory": wants_memory(error),
        "log": [line.rstrip() for line in said],
    }


_FRAMES = 6


@contextmanager
def _spoken_into(path: Path) -> Iterator[None]:
    """Send all that this process says to a file, what compiled code says before it dies too."""
    kept = os.dup(1), os.dup(2)
    with path.open("ab") as stream:
        sys.stdout.flush()
        sys.stderr.flush()
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for handle, number in zip(kept, (1, 2), strict=True):
                os.dup2(handle, number)
                os.close(handle)
