"""Finished stages on disk, each with a fingerprint of everything it depends on.

A stage's folder holds its results and ``stage.json``. The fingerprint covers gsfluent's version,
the part of the shot the stage reads, the content of its input files and the fingerprint of the
stage before it, so a changed texture exemplar redoes the texture and what follows, and leaves the
reconstruction alone. A folder whose work was cut short stays, marked incomplete, and is handed back
to the stage, which may go on from there.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

import gsfluent
from gsfluent.errors import RunError
from gsfluent.io import atomic_path, write_json

_CHUNK = 1 << 20


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
        with file.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
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

    def summary(self) -> dict[str, Any]:
        """The stage's line in ``run.json``."""
        return {
            "name": self.name,
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
            "peak_memory_bytes": self.peak_memory_bytes,
            "peak_device_memory_bytes": self.peak_device_memory_bytes,
            "resumed": self.resumed,
        }


class StageStore:
    """Runs stages or finds them finished."""

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root = root
        self.force = force
        self.results: list[StageResult] = []

    def run(self, name: str, key: str, work: Callable[[Path], dict[str, Any]]) -> StageResult:
        """Return the result of stage ``name``, doing ``work(folder)`` only when it must be done.

        Args:
            name: Folder name under the root.
            key: Fingerprint of the inputs.
            work: Writes its files into the folder and returns the report. The folder may hold what
                an earlier try with the same fingerprint left.
        """
        folder = self.root / name
        marker = folder / "stage.json"
        before = _read_marker(marker)
        same = before.get("fingerprint") == key
        if same and before.get("complete") and not self.force:
            result = StageResult(
                name,
                folder,
                key,
                before["report"],
                before["seconds"],
                before.get("cpu_seconds", 0.0),
                before["peak_memory_bytes"],
                before["peak_device_memory_bytes"],
                resumed=True,
            )
            self.results.append(result)
            return result
        if folder.exists() and (not same or self.force):
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        spent = before if same and not self.force else {}
        result = StageResult(
            name,
            folder,
            key,
            seconds=float(spent.get("seconds", 0.0)),
            cpu_seconds=float(spent.get("cpu_seconds", 0.0)),
        )
        self.results.append(result)
        write_json(marker, _marker(result, complete=False))
        complete = False
        try:
            with measured(result):
                result.report = work(folder)
            # a stage that gave up is asked again next time
            complete = result.report.get("verdict") != "failed"
        finally:
            # on failure this keeps the time already spent; when even that cannot be written, the
            # marker from before still says "incomplete", which is all a later run needs
            try:
                write_json(marker, _marker(result, complete=complete))
            except (OSError, RunError):
                if complete:
                    raise
        return result


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


def _marker(result: StageResult, *, complete: bool) -> dict[str, Any]:
    return {
        "fingerprint": result.fingerprint,
        "complete": complete,
        "report": result.report,
        **result.summary(),
    }


def _read_marker(path: Path) -> dict[str, Any]:
    """The marker, or nothing when it is missing or unreadable (then the stage is redone)."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def publish(source: Path, target: Path) -> None:
    """Show a stage's result in the result folder: a hard link where possible, else a copy."""
    with atomic_path(target) as part:
        try:
            os.link(source, part)
        except OSError:
            shutil.copyfile(source, part)
