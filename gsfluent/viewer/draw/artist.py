"""One picture at a time, always of the latest wish: the thread that draws for all browsers."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

_log = logging.getLogger(__name__)

BUDGETS = (0.12, 0.6, 4.0)
"""Seconds a picture may take: while something moves, shortly after, and when all is still."""
_SETTLE = 0.18  # seconds without a change after which a sharper picture is begun

Paint = Callable[[int, float], bool]
"""Draws for viewer (first argument) within a budget [s]; returns whether it had full size."""


@dataclass
class _Easel:
    """What one viewer wants and has."""

    wanted: int = 1
    drawn: int = 0
    level: int = 0
    sharp: bool = False
    moved: float = 0.0
    looked: float = 0.0


class Artist:
    """Draws in a thread of its own.

    A wish only marks its viewer as out of date: whatever is true when the thread gets to it is
    drawn, so no queue can build up. After a change the picture comes quickly and small, then
    sharper in steps while nothing else is asked.

    Args:
        paint: Does the drawing; an exception from it is logged and the picture left out.
    """

    def __init__(self, paint: Paint) -> None:
        self._paint = paint
        self._easels: dict[int, _Easel] = {}
        self._wake = threading.Condition()
        self._stop = False
        self._busy = False
        self._thread = threading.Thread(target=self._work, name="gsfluent-artist", daemon=True)
        self._thread.start()

    def request(self, viewer: int | None = None) -> None:
        """The picture of ``viewer`` (of all when None) is out of date."""
        with self._wake:
            now = time.monotonic()
            if viewer is not None:
                self._easels.setdefault(viewer, _Easel(wanted=0))
            for key, easel in self._easels.items():
                if viewer is None or key == viewer:
                    easel.wanted += 1
                    easel.moved = now
            self._wake.notify_all()

    def forget(self, viewer: int) -> None:
        """``viewer`` has gone."""
        with self._wake:
            self._easels.pop(viewer, None)
            self._wake.notify_all()

    def wait_idle(self, timeout: float) -> bool:
        """Wait until every picture is up to date and sharp; False when time ran out."""
        with self._wake:
            return self._wake.wait_for(
                lambda: (
                    not self._busy
                    and all(e.sharp and e.drawn == e.wanted for e in self._easels.values())
                ),
                timeout,
            )

    def close(self) -> None:
        """End the thread after the picture in hand."""
        with self._wake:
            self._stop = True
            self._wake.notify_all()
        self._thread.join(timeout=10.0)

    def _next(self) -> tuple[int, _Easel, int] | float | None:
        """Viewer, easel and level to draw; or how long to wait [s]; or None to wait for a wish."""
        behind = [(e.looked, k) for k, e in self._easels.items() if e.drawn != e.wanted]
        if behind:
            key = min(behind)[1]
            return key, self._easels[key], 0
        blurred = [(e.moved, k) for k, e in self._easels.items() if not e.sharp]
        if not blurred:
            return None
        moved, key = min(blurred)
        easel = self._easels[key]
        left = moved + _SETTLE - time.monotonic()
        return left if left > 0.0 else (key, easel, easel.level + 1)

    def _work(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                todo = self._next()
                while not self._stop and not isinstance(todo, tuple):
                    self._wake.wait(todo)
                    todo = self._next()
                if self._stop or not isinstance(todo, tuple):
                    return
                self._busy = True
                key, easel, level = todo
                easel.drawn, easel.level = easel.wanted, level
                easel.looked = time.monotonic()
            try:
                sharp = self._paint(key, BUDGETS[min(level, len(BUDGETS) - 1)])
            except Exception:
                # whatever it is, the page must live on; the next wish tries again
                _log.exception("viewer: a picture failed")
                sharp = True
            with self._wake:
                easel.sharp = sharp or level >= len(BUDGETS) - 1
