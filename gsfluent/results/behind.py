"""Files that are written beside the work: in order, by one thread, a few at most waiting."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

ROOM = 2
"""Files that may wait; more would be held in memory."""


class Behind:
    """A thread that does what it is given, one thing after the other.

    What goes wrong there is raised by the next call here. Leaving the ``with`` block waits for all
    that was given; an error of the block itself comes first.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="gsfluent-writer")
        self._given: deque[Future[Any]] = deque()

    def __enter__(self) -> Behind:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._pool.shutdown(wait=True)
        if error is None:
            self.wait()

    def do(self, work: Callable[..., Any], *given: Any) -> None:
        """Have something done after all that was given before.

        Raises:
            RunError: Something given before could not be written.
        """
        self._settle(ROOM - 1)
        self._given.append(self._pool.submit(work, *given))

    def wait(self) -> None:
        """Wait for all that was given.

        Raises:
            RunError: Some of it could not be written.
        """
        self._settle(0)

    def _settle(self, most: int) -> None:
        while len(self._given) > most:
            self._given.popleft().result()
