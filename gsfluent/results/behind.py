"""What is done beside the work: in order, by one thread, a little at most waiting."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

import torch

ROOM = 2
"""What may wait, files for example; more would be held in memory."""


class Behind:
    """A thread that does what it is given, one thing after the other.

    What goes wrong there is raised by the next call here, and what was given after it is left
    undone. Leaving the ``with`` block waits for all that was given; an error of the block itself
    comes first.

    On a GPU the thread has a stream of its own: on a common one each would wait for what the other
    has begun whenever it reads a number. What it is given is finished before it begins, and what it
    does is finished before it drops what it was given. Tensors that it keeps for longer are for
    :func:`held_here`.

    Args:
        room: How much may wait, what is being done among it.
        device: Where it computes; None or a CPU needs nothing.
        threads: With how many threads torch computes in it; None for as many as elsewhere.
    """

    def __init__(
        self,
        room: int = ROOM,
        device: torch.device | None = None,
        *,
        threads: int | None = None,
    ) -> None:
        self._room, self._failed = room, False
        on_gpu = device is not None and device.type == "cuda"
        self._stream = torch.cuda.Stream(device) if on_gpu else None
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="gsfluent-behind")
        self._given: deque[Future[Any]] = deque()
        if threads is not None:
            here = torch.get_num_threads()
            self._pool.submit(_compute_with, threads).result()
            torch.set_num_threads(here)  # for threads that compute for the first time later

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
        ready = None
        if self._stream is not None:
            ready = torch.cuda.current_stream(self._stream.device).record_event()
        self._given.append(self._pool.submit(self._one, ready, work, *given))

    @contextlib.contextmanager
    def _own_stream(self, ready: torch.cuda.Event | None) -> Iterator[None]:
        if self._stream is None or ready is None:
            yield
            return
        with torch.cuda.stream(self._stream):
            self._stream.wait_event(ready)
            try:
                yield
            finally:
                self._stream.synchronize()

    def _one(self, ready: torch.cuda.Event | None, work: Callable[..., Any], *given: Any) -> None:
        if self._failed:
            return
        try:
            with self._own_stream(ready):
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


def _compute_with(threads: int) -> None:
    """Have torch compute with so many threads in the thread that asks."""
    torch.get_num_threads()  # the first look takes the number of all, and would undo the next line
    torch.set_num_threads(threads)


def held_here(*values: Any) -> None:
    """Let tensors made on another stream be kept by the present one for as long as it likes.

    Their memory is not used again before this stream is done with it. Tuples and dataclasses are
    looked through; tensors on a CPU need nothing.
    """
    for value in values:
        if torch.is_tensor(value):
            if value.is_cuda:
                value.record_stream(torch.cuda.current_stream(value.device))
        elif isinstance(value, tuple):
            held_here(*value)
        elif dataclasses.is_dataclass(value):
            held_here(*(getattr(value, field.name) for field in dataclasses.fields(value)))
