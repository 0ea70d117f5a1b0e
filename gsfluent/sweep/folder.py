"""The folder of a sweep: what is done, what is claimed, what is at work, what has failed.

``shots/ID`` is a finished task, whole or not there; ``work/ID.TRY`` a try at one; ``claims/ID``
says who is at work on it; ``failed/ID.TRY.json`` is a try that went wrong. Nothing else is
remembered, so any driver can go on from it, also several at a time.
"""

from __future__ import annotations

import dataclasses
import os
import secrets
import shutil
import socket
import time
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from gsfluent.sweep.claims import (
    claimed,
    has_ended,
    is_stale,
    myself,
    read_words,
    write_words,
)

ROW = "row.json"
"""What a task returned, in its folder."""
LOG = "log.txt"
"""What a try has said."""
OWNER = "try.json"
"""Who makes a try, in its folder."""
_LAST_LINES = 50


@dataclasses.dataclass(frozen=True)
class SweepFolder:
    """The folder of a sweep."""

    root: Path

    @property
    def address(self) -> str | Path:
        """What other processes open it by."""
        return self.root

    @property
    def shots(self) -> Path:
        """Where finished tasks lie."""
        return self.root / "shots"

    def make(self) -> None:
        """Make it, where it is missing."""
        for name in ("shots", "work", "claims", "failed"):
            (self.root / name).mkdir(parents=True, exist_ok=True)

    def claim(self, name: str) -> Path:
        """The claim of a task."""
        return self.root / "claims" / name

    def held(self, name: str) -> AbstractContextManager[bool]:
        """Hold the claim of a task; whether it is ours, as of :func:`claims.claimed`."""
        return claimed(self.claim(name))

    def free(self, name: str) -> None:
        """Drop the claim of a process that is known to have ended."""
        self.claim(name).unlink(missing_ok=True)

    def abandoned(self, names: Iterable[str]) -> list[str]:
        """Those of some tasks that nobody is at work on."""
        clock = self.claim(f".clock.{os.getpid()}")
        clock.touch()
        now = clock.stat().st_mtime
        clock.unlink()
        return [name for name in names if is_stale(self.claim(name), now)]

    def done(self) -> set[str]:
        """Names of the finished tasks."""
        try:
            with os.scandir(self.shots) as found:
                return {entry.name for entry in found}
        except FileNotFoundError:
            return set()

    def is_done(self, name: str) -> bool:
        """Whether a task is finished."""
        return (self.shots / name).exists()

    def row(self, name: str) -> dict[str, Any] | None:
        """The row of a finished task.

        It has ``id``, ``value``, ``tries``, ``host``, ``process``, ``began`` and ``seconds``.
        """
        return read_words(self.shots / name / ROW)

    def rows(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """The rows of those of some tasks that are finished."""
        return {name: row for name in names if (row := self.row(name)) is not None}

    def files(self, name: str) -> Path | None:
        """Where the files of a finished task lie; None where that is not on this machine."""
        return self.shots / name

    def begin(self, name: str) -> Path:
        """A folder for a try, with what a try of a process that has ended left in it.

        Of more such, and of what is not known to have ended, nothing is taken.
        """
        mine = self.root / "work" / f"{name}.{secrets.token_hex(4)}"
        for left in self.tries(name):
            if not has_ended(read_words(left / OWNER) or {}):
                continue
            if mine.exists():
                shutil.rmtree(left, ignore_errors=True)
                continue
            with suppress(OSError):  # another driver was quicker
                left.rename(mine)
        mine.mkdir(exist_ok=True)
        write_words(mine / OWNER, myself())
        return mine

    def tries(self, name: str, process: int | None = None) -> list[Path]:
        """Folders of unfinished tries at a task, all or those of a process of this machine."""
        found = sorted((self.root / "work").glob(f"{name}.*"))
        if process is None:
            return found
        here = socket.gethostname()
        owners = [read_words(path / OWNER) or {} for path in found]
        return [
            path
            for path, owner in zip(found, owners, strict=True)
            if (owner.get("process"), owner.get("host")) == (process, here)
        ]

    def finish(self, name: str, folder: Path, row: dict[str, Any]) -> bool:
        """Give a try its place among the finished; False, and it is thrown away, if that is taken.

        Raises:
            OSError: The disk is full.
        """
        write_words(folder / ROW, row)
        (folder / OWNER).unlink(missing_ok=True)
        _sync(folder)
        try:
            folder.rename(self.shots / name)
        except OSError:
            if not self.is_done(name):
                raise
            shutil.rmtree(folder, ignore_errors=True)
            return False
        _sync(self.shots)
        self.forgive([name])
        return True

    def tidy(self) -> None:
        """Remove claims of processes that have ended, and their tries at what is finished."""
        for claim in (self.root / "claims").iterdir():
            if has_ended(read_words(claim) or {}):
                claim.unlink(missing_ok=True)
        for left in (self.root / "work").iterdir():
            ended = has_ended(read_words(left / OWNER) or {})
            if ended and self.is_done(left.name.partition(".")[0]):
                shutil.rmtree(left, ignore_errors=True)

    def fail(self, name: str, record: dict[str, Any]) -> None:
        """Note a try that went wrong.

        Args:
            name: The task.
            record: ``kind``, ``message``, ``log`` (its last lines), ``again``: whether another try
                may end otherwise.
        """
        path = self.root / "failed" / f"{name}.{secrets.token_hex(4)}.json"
        part = path.with_suffix(".part")
        host, when = socket.gethostname(), time.time()
        write_words(part, {"id": name, "host": host, "seconds": when, **record})
        os.replace(part, path)

    def failures(self, name: str = "") -> dict[str, list[dict[str, Any]]]:
        """Tries that went wrong, of all tasks or of one, by name, the oldest first."""
        found: dict[str, list[dict[str, Any]]] = {}
        for path in (self.root / "failed").glob(f"{name or '*'}.*.json"):
            if record := read_words(path):
                found.setdefault(str(record["id"]), []).append(record)
        for records in found.values():
            records.sort(key=lambda record: float(record["seconds"]))
        return found

    def forgive(self, names: Iterable[str]) -> None:
        """Forget the failed tries of tasks."""
        for name in names:
            for path in (self.root / "failed").glob(f"{name}.*.json"):
                path.unlink(missing_ok=True)


def last_lines(folder: Path) -> list[str]:
    """The last lines that a try has said."""
    try:
        return (folder / LOG).read_text(errors="replace").splitlines()[-_LAST_LINES:]
    except OSError:
        return []


def _sync(folder: Path) -> None:
    """Make sure that the names in a folder are on the disk, where a folder can be synced."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
