"""One command of gsfluent in a process of its own: its progress, its end, and a way to stop it.

A process, because Ctrl-C is how a run is stopped without losing what it has done.
"""

from __future__ import annotations

import collections
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

_KEPT = 40  # lines of its log
_PATIENCE = 20.0  # seconds that a stopped command has to write what it keeps
_PROGRESS = re.compile(r"^(\w[\w ]*): (\d+)/(\d+)")

RUNNING, DONE, FAILED, STOPPED = "at work", "done", "failed", "stopped"


class Job:
    """A command at work.

    Attributes:
        name: What the page calls it.
        began: When it began, of ``time.monotonic``.
        lines: The end of its log.
        answer: What it wrote to stdout.

    Args:
        name: See above.
        words: Verb and arguments.
        folder: Where it runs.
    """

    def __init__(self, name: str, words: list[str], folder: Path) -> None:
        self.name, self.began = name, time.monotonic()
        self.lines: collections.deque[str] = collections.deque(maxlen=_KEPT)
        self.answer = ""
        self._stopped = False
        self._ended: float | None = None
        self._process = subprocess.Popen(
            # -P: a file of the folder must not pass for a module
            [sys.executable, "-P", "-m", "gsfluent", *words],
            cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, errors="replace", env=os.environ | {"COLUMNS": "90"},
        )  # fmt: skip
        self._readers = [
            threading.Thread(target=read, daemon=True) for read in (self._log, self._take)
        ]
        for reader in self._readers:
            reader.start()

    @property
    def state(self) -> str:
        """One of the four words above."""
        if self._ended is None:
            if self._process.poll() is None or any(r.is_alive() for r in self._readers):
                return RUNNING
            self._ended = time.monotonic()
        if self._stopped:
            return STOPPED
        return DONE if self._process.returncode == 0 else FAILED

    @property
    def seconds(self) -> float:
        """How long it has been, or was, at work."""
        return (self._ended or time.monotonic()) - self.began

    @property
    def progress(self) -> tuple[str, float] | None:
        """What is counted last and how far that is in 0..1; None before the first count."""
        for line in reversed(self.lines):
            found = _PROGRESS.match(line)
            if found:
                return found[1], min(int(found[2]) / max(int(found[3]), 1), 1.0)
        return None

    def stop(self) -> None:
        """End it as Ctrl-C does: what is finished is kept."""
        if self._process.poll() is None:
            self._stopped = True
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                self._process.kill()

    def _log(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self.lines.append(line.rstrip())

    def _take(self) -> None:
        assert self._process.stdout is not None
        self.answer = self._process.stdout.read()
