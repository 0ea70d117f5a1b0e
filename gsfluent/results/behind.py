"""What is done beside the work: in order, by one thread, a little at most waiting."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

ROOM = 2
"""What may wait, files for example; more would be held in memory."""


class Behind:
    """A thread that does what it is given, one thing after the other.

    What goes wrong there is raised by the next call here, and what was given after it is left
    undone. Leaving the ``with`` block waits for all that was given; an error of the block itself
    comes first.

    Args:
        room: How much may wait, what is being done among it.
    """

    def __init__(self, room: int = ROOM) -> None:
        self._room, self._failed = room, False
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="gsfluent-behind")
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
            Exception: What went wrong with something given before.
        """
        self._settle(self._room - 1)
        self._given.append(self._pool.submit(self._one, work, *given))

    def _one(self, work: Callable[..., Any], *given: Any) -> None:
        if self._failed:
            return
        try:
            work(*given)
        except BaseException:
            self._failed = True
            raise

    def wait(self) -> None:
        """Wait for all that was given.

        Raises:
            Exception: What went wrong with some of it.
        """
        self._settle(0)

    def _settle(self, most: int) -> None:
        while len(self._given) > most:
            self._given.popleft().result()
