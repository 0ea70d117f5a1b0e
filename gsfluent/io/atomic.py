"""Writing files so that a reader never meets half of one."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, cast

from gsfluent.errors import RunError
from gsfluent.process import is_alive

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PARTIAL = re.compile(r"^\..*\.(\d+)\.partial")

Watcher = Callable[[Path, Path], None]
_watchers: list[Watcher] = []


@contextlib.contextmanager
def watching(watcher: Watcher) -> Iterator[None]:
    """While the block runs, call ``watcher(temporary, path)`` before each file appears."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


@contextlib.contextmanager
def atomic_path(path: str | Path, *, synced: bool = True) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; rename it onto ``path`` when the block ends well.

    The temporary keeps the suffix (writers that look at it work) and lies in the same directory, so
    the rename is one step of the file system. When the block fails, Ctrl-C included, the temporary
    is removed and an older ``path`` stays as it was.

    Args:
        path: Where the file shall appear.
        synced: Wait until its bytes are on the disk, so that it is whole after a power cut, too.
            What has a digest (:mod:`gsfluent.results.digests`) needs no such wait: a torn file
            would be noticed and made again.

    Raises:
        RunError: The disk is full or the folder cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if synced:
            with open(temporary, "rb") as stream:
                os.fsync(stream.fileno())
        for watcher in _watchers:
            watcher(temporary, path)
        os.replace(temporary, path)
    except OSError as error:
        if error.errno in (*_FULL, errno.EACCES, errno.EROFS):
            raise RunError(
                f"{path}: cannot be written ({error.strerror})",
                "nothing; the file was not touched",
                "free space or choose another output folder, then run again",
            ) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def link_or_copy(source: str | Path, target: str | Path) -> None:
    """Give a file that is never written in place one more name: a hard link, else a copy."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def remove_partials(folder: Path) -> list[Path]:
    """Remove the temporaries below a folder whose processes have ended; return their paths."""
    found = []
    for path in folder.rglob(".*.partial*"):
        name = _PARTIAL.match(path.name)
        with contextlib.suppress(FileNotFoundError):
            if name and path.is_file() and not is_alive(int(name[1]), path.stat().st_mtime):
                path.unlink()
                found.append(path)
    return found


class _Stream:
    """A file that remembers why a write failed: torch tells of its own confusion only."""

    def __init__(self, raw: Any) -> None:
        self.raw = raw
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return int(self.raw.write(data))
        except OSError as error:
            self.error = self.error or error
            raise

    def flush(self) -> None:
        self.raw.flush()


def write_tensors(path: str | Path, values: dict[str, Any]) -> None:
    """Write with ``torch.save``, atomically.

    Raises:
        RunError: The disk is full or the folder cannot be written.
    """
    import torch

    with atomic_path(path) as temporary, open(temporary, "wb", buffering=0) as raw:
        stream = _Stream(raw)
        try:
            torch.save(values, cast(IO[bytes], stream))
        except Exception as error:
            raise (stream.error or error) from None


def to_json(value: Any) -> str:
    """Indented JSON with a final newline; NaN and infinity become null."""
    return json.dumps(_finite(value), indent=1, allow_nan=False) + "\n"


def write_json(path: str | Path, value: Any) -> None:
    """Write :func:`to_json` of a value atomically."""
    text = to_json(value)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _finite(value: Any) -> Any:
    """Replace what JSON cannot hold."""
    if isinstance(value, float) and not -float("inf") < value < float("inf"):
        return None
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value
