"""Finished stages on disk, each with a fingerprint of everything it depends on.

A stage's folder holds its results and ``stage.json``. The fingerprint covers gsfluent's version,
the part of the shot the stage reads, the content of its input files and the fingerprint of the
stage before it, so a changed texture exemplar redoes the texture and what follows, and leaves the
reconstruction alone. A folder whose work was cut short stays, marked incomplete, and is handed back
to the stage, which may go on from there. Nothing is taken up before its files were compared with
their digests; a stage of which one differs is done anew, and the run says so.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

import gsfluent
from gsfluent.errors import RunError
from gsfluent.io import atomic_path
from gsfluent.io.atomic import link_or_copy, watching
from gsfluent.results.digests import (
    RECORD,
    WRITTEN,
    Journal,
    differing,
    read_record,
    update,
    write_record,
)

_log = logging.getLogger(__name__)
_READ_ON = (".ply", ".npz", ".json")
_KEPT = ("report", "seconds", "cpu_seconds", "peak_memory_bytes", "peak_device_memory_bytes")


def fingerprint(*parts: object) -> str:
    """Hex digest of anything JSON can hold; other values count by their ``repr``."""
    text = json.dumps([gsfluent.__version__, *parts], sort_keys=True, default=repr)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def content_digest(path: Path) -> str:
    """Hex digest of a file, or of every file below a folder with its relative name.

    Content, not modification time: a fresh clone or a copied folder is still the same input.
    """
    digest = hashlib.blake2b(digest_size=16)
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        name = file.relative_to(path).as_posix() if path.is_dir() else file.name
        digest.update(f"{name}\0{file.stat().st_size}\0".encode())
        update(digest, file)
    return digest.hexdigest()


@dataclass
class StageResult:
    """What one stage left behind."""

    name: str  # Stage name
    folder: Path  # Where its files are
    fingerprint: str  # Of everything that went in
    report: dict[str, Any] = field(default_factory=dict)  # Figures for ``run.json``
    seconds: float = 0.0  # Work time, also of earlier, interrupted tries
    # Processor time of all threads, likewise: on a busy machine the steadier figure.
    cpu_seconds: float = 0.0
    peak_memory_bytes: int = 0  # Highest resident memory of the process during the stage
    # Highest memory allocated on the GPU during the stage (0 on CPU).
    peak_device_memory_bytes: int = 0
    resumed: bool = False  # The whole result was found finished
    files: dict[str, str] = field(default_factory=dict)  # Digest of each file of a finished stage
    redone: str = ""  # Why what had been there was not believed and done anew

    @property
    def content(self) -> str:
        """Digest of what later stages read: not of the stage's own report, which holds times."""
        read = {
            name: digest
            for name, digest in self.files.items()
            if name.endswith(_READ_ON) and not name.startswith(f"{self.name}.")
        }
        return fingerprint(read)

    def save(self, *, complete: bool = True) -> None:
        """Write ``stage.json``.

        Raises:
            RunError: The disk is full.
        """
        head = {"fingerprint": self.fingerprint, "complete": complete}
        files = {"files": self.files} if complete else {}
        values = {**head, **files, "report": self.report, **self.summary()}
        write_record(self.folder / RECORD, values)

    def summary(self) -> dict[str, Any]:
        """The stage's line in ``run.json``."""
        redone = {"redone": self.redone} if self.redone else {}
        return {
            "name": self.name,
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
            "peak_memory_bytes": self.peak_memory_bytes,
            "peak_device_memory_bytes": self.peak_device_memory_bytes,
            "resumed": self.resumed,
            **redone,
        }


class StageStore:
    """Runs stages or finds them finished.

    Args:
        root: Where their folders lie.
        force: Do finished stages anew.
        shared: Folder of finished stages by fingerprint, for many stores: what lies there is
            linked and not done, what is done is left there, and of several stores at work on
            the same stage one does it. None for no such folder; may be changed between stages.
    """

    def __init__(self, root: Path, *, force: bool = False, shared: Path | None = None) -> None:
        self.root = root
        self.force = force
        self.shared = shared
        self.results: list[StageResult] = []

    def run(
        self,
        name: str,
        key: str,
        work: Callable[[Path], dict[str, Any]],
        scratch: Sequence[str] = (),
    ) -> StageResult:
        """Return the result of stage ``name``, doing ``work(folder)`` only when it must be done.

        Args:
            name: Folder name under the root.
            key: Fingerprint of the inputs.
            work: Writes its files into the folder and returns the report. The folder may hold what
                an earlier try with the same fingerprint left, which is as that try wrote it.
            scratch: Files that only an unfinished stage needs; they are removed in the end.
        """
        if self.shared is None:
            return self._run(name, key, work, scratch)
        with _alone(self.shared, key):
            common = self.shared / key
            if common.is_dir() and not (self.root / name).exists():
                _link_tree(common, self.root / name)
            result = self._run(name, key, work, scratch)
            inside = not any(file.startswith("../") for file in result.files)
            if result.files and inside and not (result.resumed and common.is_dir()):
                _replace_tree(self.root / name, common)
        return result

    def _run(
        self, name: str, key: str, work: Callable[[Path], dict[str, Any]], scratch: Sequence[str]
    ) -> StageResult:
        """:meth:`run` of a stage that nobody else wants."""
        folder = self.root / name
        journal = Journal(folder, self.root.parent)
        before, wrong = read_record(folder / RECORD) if _holds_results(folder) else ({}, "")
        same = not self.force and before.get("fingerprint") == key
        if same and before.get("complete"):
            missing = [each for each in ("files", *_KEPT) if each not in before]
            lost = [] if missing else differing(folder, before["files"])
            wrong = f"{_listed(lost)} missing or different from the digest" if lost else ""
            if missing:
                wrong = f"{RECORD} is without {missing[0]}"
            if not wrong:
                result = _found(name, folder, before)
                self.results.append(result)
                _clear(folder, journal, scratch)
                return result
        elif same:
            wrong = journal.read()
        if wrong and not self.force:
            _log.warning("%s: %s; the stage is done anew", name, wrong)
            same = False
        if not same:
            _begin_anew(folder, journal, before, damaged=bool(wrong))
        spent = before if same else {}
        result = StageResult(
            name,
            folder,
            key,
            seconds=float(spent.get("seconds", 0.0)),
            cpu_seconds=float(spent.get("cpu_seconds", 0.0)),
            redone="" if self.force else wrong,
        )
        self.results.append(result)
        result.save(complete=False)
        complete = False
        try:
            with measured(result), watching(journal.note):
                result.report = work(folder)
            # a stage that gave up is asked again next time
            complete = result.report.get("verdict") != "failed"
            if complete:
                result.files = journal.files(scratch)
        finally:
            # on failure this keeps the time already spent; when even that cannot be written, the
            # record from before still says "incomplete", which is all a later run needs
            try:
                result.save(complete=complete)
            except (OSError, RunError):
                if complete:
                    raise
        if complete:
            _clear(folder, journal, scratch)
        return result


@contextmanager
def _alone(shared: Path, key: str) -> Iterator[None]:
    """Keep a shared stage to this process; where a file system has no locks, two may do it."""
    shared.mkdir(parents=True, exist_ok=True)
    handle = os.open(shared / f"{key}.lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _link_tree(source: Path, target: Path) -> None:
    """The files of a folder once more."""
    shutil.copytree(source, target, copy_function=link_or_copy)


def _replace_tree(source: Path, target: Path) -> None:
    """Put the files of a folder where others look for them, all at once."""
    part = target.with_name(f".{target.name}.{os.getpid()}")
    shutil.rmtree(part, ignore_errors=True)
    _link_tree(source, part)
    shutil.rmtree(target, ignore_errors=True)  # what was damaged
    try:
        part.rename(target)
    except OSError:  # another was quicker where there are no locks
        shutil.rmtree(part, ignore_errors=True)


def _holds_results(folder: Path) -> bool:
    """Whether there is more than what a run killed at the very start of a stage leaves."""
    names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    return any(name != WRITTEN and not name.startswith(".") for name in names)


def _found(name: str, folder: Path, record: dict[str, Any]) -> StageResult:
    """A finished stage, from its record."""
    return StageResult(
        name,
        folder,
        record["fingerprint"],
        **{each: record[each] for each in _KEPT},
        resumed=True,
        files=record["files"],
    )


def _listed(names: list[str]) -> str:
    """A few names in words, with the verb."""
    more = f" and {len(names) - 1} more files are" if len(names) > 1 else " is"
    return f"{names[0]}{more}"


def _begin_anew(folder: Path, journal: Journal, record: dict[str, Any], *, damaged: bool) -> None:
    """Empty a stage's folder; of files that it wrote elsewhere only the damaged ones' go."""
    outside = {
        name: known
        for name, known in (record.get("files") or {}).items()
        if name.startswith("../") and (folder / name).is_file()
    }
    if damaged:
        for name in outside:
            (folder / name).unlink()
    if folder.exists():
        shutil.rmtree(folder)
    journal.keep({} if damaged else outside)


def _clear(folder: Path, journal: Journal, scratch: Sequence[str]) -> None:
    """Remove what a finished stage needs no more."""
    journal.remove()
    for name in scratch:
        (folder / name).unlink(missing_ok=True)


@contextmanager
def measured(result: StageResult) -> Iterator[None]:
    """Add wall time and record peak memory of the enclosed work."""
    on_gpu = torch.cuda.is_available() and torch.cuda.is_initialized()
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    _reset_peak_memory()
    start, busy = time.perf_counter(), time.process_time()
    try:
        yield
    finally:
        result.seconds += time.perf_counter() - start
        result.cpu_seconds += time.process_time() - busy
        result.peak_memory_bytes = _peak_memory()
        if torch.cuda.is_available() and torch.cuda.is_initialized():
            result.peak_device_memory_bytes = int(torch.cuda.max_memory_allocated())


def _reset_peak_memory() -> None:
    """Start a new high-water mark where the kernel can (Linux); else it counts from the start."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak_memory() -> int:
    """Highest resident memory of this process in bytes since the last reset."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def publish(result: StageResult, name: str, target: Path) -> None:
    """Show a stage's result in the result folder: a hard link where possible, else a copy.

    Raises:
        RunError: The file is not what the stage has written, or the disk is full.
    """
    source = result.folder / name
    if differing(result.folder, {name: result.files[name]}):
        raise RunError(
            f"{source}: changed since it was written",
            "the other stages",
            "run the same command again; it does this stage anew",
        )
    with atomic_path(target) as part:
        link_or_copy(source, part)
