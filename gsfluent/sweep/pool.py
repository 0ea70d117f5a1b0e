"""A pool of spawned processes of this machine; one that dies takes nothing with it but its try."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import Any

from gsfluent.errors import InputError, RunError
from gsfluent.hardware import bound_memory, graphics_cards
from gsfluent.sweep.attempt import FAILED, Function, attempt
from gsfluent.sweep.bucket import opened
from gsfluent.sweep.folder import last_lines

_PATIENCE = 20.0  # seconds in which a stopped task may put down what it has
_BROKEN = "broken"  # a try that could not even note its failure
_SPAWN = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork


@dataclasses.dataclass(eq=False)
class _Worker:
    process: Any
    pipe: Connection
    card: str = ""  # Its GPU; empty where none is asked for
    task: str = ""  # Its task; empty while it has none
    since: float = 0.0  # When it got it
    ready: bool = False  # Whether it has said that it has begun with it


class LocalPool:
    """Tries tasks in processes of this machine, each with threads of its own.

    Args:
        root: Folder of the sweep, or its store.
        function: What a task does; importable by name, since processes are spawned.
        jobs: Tasks at a time.
        minutes: Longest time of a try; None for any.
        threads: Threads of a process.
        gpu: Part of a GPU that a process takes; 0 for none. As many as fit share one, each with a
            bound on its memory.

    Raises:
        InputError: The function cannot be sent to another process, or there is no GPU.
    """

    def __init__(
        self, root: str | Path, function: Function, *, jobs: int, minutes: float | None,
        threads: int = 1, gpu: float = 0.0,
    ) -> None:  # fmt: skip
        try:
            pickle.dumps(function)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(
                f"sweep: {function!r} cannot be sent to another process ({error})",
                "give a function that stands at the top of a module",
            ) from error
        self._place, self._function, self._jobs = opened(root), function, jobs
        self._seconds = None if minutes is None else 60.0 * minutes
        self._threads, self._gpu = threads, gpu
        self._cards = graphics_cards() if gpu else []
        if gpu:
            if not self._cards:
                raise InputError("sweep: no GPU is visible here", "use a CPU, or another machine")
            self._jobs = min(jobs, len(self._cards) * int(1.0 / gpu + 1e-6))
        self._workers: list[_Worker] = []
        self._stillborn = 0

    def room(self) -> int:
        """How many tasks may be started now."""
        return self._jobs - sum(bool(worker.task) for worker in self._workers)

    def start(self, name: str, item: Any) -> None:
        """Hand out a task; there is room for one."""
        worker = next((w for w in self._workers if not w.task), None) or self._spawn()
        worker.task, worker.since, worker.ready = name, time.monotonic(), False
        with contextlib.suppress(OSError):  # it has just died, which `ended` will find
            worker.pipe.send((name, item))

    def ended(self, seconds: float) -> list[tuple[str, str]]:
        """Tasks whose tries have ended, each with how; waits a while for one.

        A task that was handed to a process that never ran comes back as "".

        Raises:
            RunError: Processes die as they start, or a failure cannot be written down.
        """
        busy = [w for w in self._workers if w.task]
        wait([x for w in self._workers for x in (w.pipe, w.process.sentinel)], seconds)
        found = []
        for worker in busy:
            state = self._state(worker)
            if state is not None:
                found.append((worker.task, state))
                worker.task = ""
        # one that has just died with its task is looked at again, and not forgotten
        self._workers = [w for w in self._workers if w.task or w.process.is_alive()]
        return found

    def close(self) -> None:
        """End all processes; a task at work puts down what it has, as after Ctrl-C."""
        for worker in self._workers:
            worker.process.terminate()
        end = time.monotonic() + _PATIENCE
        for worker in self._workers:
            worker.process.join(max(end - time.monotonic(), 0.0))
            worker.process.kill()
            worker.process.join()
        self._workers = []

    def _state(self, worker: _Worker) -> str | None:
        """How a worker's try has ended; None while it has not."""
        try:
            while worker.pipe.poll():
                state, words = worker.pipe.recv()
                if state == _BROKEN:
                    raise RunError(
                        f"{worker.task}: {words}", f"what is in {self._place.address}",
                        "free space, then run the same command again",
                    )  # fmt: skip
                if state:
                    self._stillborn = 0
                    if state == FAILED:  # what its process is left with nobody knows
                        worker.process.join()
                    return str(state)
                worker.ready, worker.since = True, time.monotonic()
        except (EOFError, OSError):
            worker.process.join()
        late = self._seconds is not None and time.monotonic() - worker.since > self._seconds
        if late and worker.ready and worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
            minutes = (self._seconds or 0.0) / 60.0
            return self._buried(worker, "time", f"took longer than {minutes:.3g} minutes", False)
        if worker.process.is_alive():
            return None
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn > 3 + self._jobs:
                raise RunError(
                    "sweep: processes end as soon as they start",
                    f"what is in {self._place.address}",
                    "a script that calls gsfluent.sweep.map needs `if __name__ == '__main__':`",
                )  # fmt: skip
            return ""
        code = worker.process.exitcode
        killed = code is not None and code < 0
        said = f"killed by {_signal(-code)}" if killed else f"ended with exit code {code}"
        return self._buried(worker, "process", said, True)

    def _buried(self, worker: _Worker, kind: str, said: str, again: bool) -> str:
        """Note the try of a worker that is dead; what it left is kept for the next one."""
        left = self._place.tries(worker.task, worker.process.pid)
        log = last_lines(left[0]) if left else []
        self._place.fail(worker.task, {"kind": kind, "message": said, "again": again, "log": log})
        self._place.free(worker.task)
        if not again:
            for folder in left:
                shutil.rmtree(folder, ignore_errors=True)
        return FAILED

    def _spawn(self) -> _Worker:
        ours, theirs = _SPAWN.Pipe()
        process = _SPAWN.Process(
            target=_serve, args=(theirs, self._place.address, self._function, self._gpu),
            daemon=True,
        )  # fmt: skip
        taken = [worker.card for worker in self._workers]
        card = min(self._cards, key=taken.count, default="")
        variables = {"OMP_NUM_THREADS": str(self._threads)}
        with environment(variables | ({"CUDA_VISIBLE_DEVICES": card} if card else {})):
            process.start()
        theirs.close()
        worker = _Worker(process, ours, card)
        self._workers.append(worker)
        return worker


@contextlib.contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """Variables of processes that start meanwhile, which read them when they import torch."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _serve(pipe: Connection, root: str | Path, function: Function, gpu: float) -> None:
    """Try the tasks that come, until one fails or nobody is there any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the driver says what to do
    signal.signal(signal.SIGTERM, _stop)
    threading.Thread(target=_end_with_the_driver, daemon=True).start()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        if 0.0 < gpu < 1.0:
            bound_memory(gpu)
        while True:
            name, item = pipe.recv()
            pipe.send(("", ""))
            try:
                state, words = attempt(root, name, function, item), ""
            except Exception as error:
                state, words = _BROKEN, f"{type(error).__name__}: {error}"
            pipe.send((state, words))
            if state in (FAILED, _BROKEN):
                return


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt("stopped by the driver of the sweep")


def _end_with_the_driver() -> None:
    driver = multiprocessing.parent_process()
    assert driver is not None  # this process was spawned
    wait([driver.sentinel])
    os._exit(1)
