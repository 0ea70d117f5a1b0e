"""Progress of long work: a bar on a terminal, plain log lines anywhere else.

Every stage takes ``progress: Callable[[int, int, str], None]``, called with (done, total, what is
being done). The stages know nothing of terminals; :func:`reporter` decides once which of the two
forms the caller sees. Both write to stderr, so that stdout stays free for ``--json``.
"""

from __future__ import annotations

import dataclasses
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

_log = logging.getLogger(__name__)

# A log file is read later by a person: one line every few seconds says as much as a thousand. A
# second less than the longest silence that is promised, for a busy machine wakes nobody in time.
_LONGEST_SILENCE = 4.0
_SECONDS_BETWEEN_LINES = 3.0  # of one task, so that progress comes before its silence is broken


class Reporter(Protocol):
    """Hands out one progress callback per task."""

    def task(self, name: str) -> Progress:
        """Return the callback for one task called ``name``."""
        ...


class LineReporter:
    """Writes a log line per task at most every few seconds, and one when the task is complete."""

    def __init__(self, seconds: float = _SECONDS_BETWEEN_LINES) -> None:
        self._seconds = seconds

    def task(self, name: str) -> Progress:
        """Return the callback for one task called ``name``."""
        last = time.monotonic()
        finished = False

        def report(done: int, total: int, text: str) -> None:
            nonlocal last, finished
            now = time.monotonic()
            complete = total > 0 and done >= total
            if (complete and not finished) or now - last >= self._seconds:
                last, finished = now, complete
                _log.info("%s: %s", name, f"{done}/{total} {text}".rstrip())

        return report


class BarReporter:
    """Draws one rich progress bar per task on stderr."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
        from rich.progress import Progress as RichProgress

        self.bars = RichProgress(
            TextColumn("{task.fields[name]:<12}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=Console(stderr=True),
            refresh_per_second=4,
        )

    def task(self, name: str) -> Progress:
        """Return the callback for one task called ``name``."""
        bar = self.bars.add_task("", name=name, total=None)

        def report(done: int, total: int, text: str) -> None:
            self.bars.update(
                bar, completed=done, total=total if total > 0 else None, description=text
            )

        return report


@contextmanager
def reporter(*, quiet: bool = False) -> Iterator[Reporter]:
    """Yield the reporter that suits this process: bars on a terminal, lines elsewhere.

    Args:
        quiet: Lines even on a terminal (``--json``: logs, not drawings, beside the object).
    """
    if quiet or not sys.stderr.isatty():
        yield LineReporter()
        return
    bars = BarReporter()
    with bars.bars:
        yield bars


@contextmanager
def quiet_logs(name: str, level: int = logging.WARNING) -> Iterator[None]:
    """Keep log lines below ``level`` of a logger to itself, while many small runs are made.

    Args:
        name: Of the logger.
        level: The least level that is still heard.
    """
    log = logging.getLogger(name)
    before = log.level
    log.setLevel(level)
    try:
        yield
    finally:
        log.setLevel(before)


class _Heard(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        said = record.getMessage()
        if said not in self.said:
            self.said.append(said)


@contextmanager
def heard_warnings(name: str) -> Iterator[list[str]]:
    """Collect the warnings that a logger and those below it give, each sentence once.

    Args:
        name: Of the logger.
    """
    log, heard = logging.getLogger(name), _Heard()
    log.addHandler(heard)
    try:
        yield heard.said
    finally:
        log.removeHandler(heard)


class _Pulse(logging.Handler):
    """Remembers when something was last said."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.last = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        self.last = time.monotonic()


@dataclasses.dataclass(frozen=True)
class _Watched:
    """A reporter of which it is known when it last drew, and that says more than it is told."""

    inner: Reporter
    pulse: _Pulse
    adds: Callable[[str, int, int], str] | None

    def task(self, name: str) -> Progress:
        """The callback of the reporter, watched."""
        report = self.inner.task(name)

        def watched(done: int, total: int, text: str) -> None:
            more = "" if self.adds is None else self.adds(name, done, total)
            report(done, total, f"{text}, {more}" if text and more else text or more)
            # a log says itself when it has said something; a bar draws at once
            if _draws(self.inner):
                self.pulse.last = time.monotonic()

        return watched


def _draws(reporter: Reporter) -> bool:
    """Whether bars are drawn at once, behind all who watch."""
    while isinstance(reporter, _Watched):
        reporter = reporter.inner
    return not isinstance(reporter, LineReporter)


@contextmanager
def heartbeat(
    name: str,
    says: Callable[[], str],
    seconds: float = _LONGEST_SILENCE,
    adds: Callable[[str, int, int], str] | None = None,
    first: float | None = None,
) -> Iterator[Callable[[Reporter], Reporter]]:
    """Say something whenever nothing has been said for a while.

    Args:
        name: Of the logger that counts, and that is spoken to.
        says: Makes the line.
        seconds: Longest silence.
        adds: Makes what is added to the progress of a task, from its name, done and total.
        first: Longest silence at the start; ``seconds`` by default.

    Returns:
        Takes a reporter and gives one whose drawing counts as saying something.
    """
    log, pulse, over = logging.getLogger(name), _Pulse(), threading.Event()

    def beat() -> None:
        wait = seconds if first is None else first
        while not over.wait(wait):
            wait = seconds - (time.monotonic() - pulse.last)
            if wait <= 0.05 * seconds:
                # past the level: small runs whose lines are kept back are what takes long
                words = log.makeRecord(log.name, logging.INFO, __file__, 0, says(), (), None)
                log.handle(words)
                wait = seconds

    log.addHandler(pulse)
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield lambda reporter: _Watched(reporter, pulse, adds)
    finally:
        over.set()
        thread.join()
        log.removeHandler(pulse)


Progress = Callable[[int, int, str], None]
"""``progress(done, total, note)``: called by a stage as it goes; ``None`` means nobody listens."""


def report_progress(progress: Progress | None, done: int, total: int, note: str = "") -> None:
    """Call ``progress`` when there is one."""
    if progress is not None:
        progress(done, total, note)
