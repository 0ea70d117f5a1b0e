"""Many tasks, each once: what is left is handed out, what went wrong is tried again or listed."""

from __future__ import annotations

import collections
import dataclasses
import os
import re
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

from gsfluent.errors import InputError, RunError
from gsfluent.progress import Progress, report_progress
from gsfluent.sweep.attempt import DONE, FAILED, Function
from gsfluent.sweep.bucket import opened
from gsfluent.sweep.folder import SweepFolder
from gsfluent.sweep.pool import LocalPool

TRIES = 3
"""How often a task is tried whose tries end for reasons of the moment."""
_TICK = 1.0
_NAME = re.compile(r"[\w-]+")


class Engine(Protocol):
    """Places tasks: processes of this machine, a cluster."""

    def room(self) -> int:
        """How many tasks may be started now."""
        ...

    def start(self, name: str, item: Any) -> None:
        """Hand out a task."""
        ...

    def ended(self, seconds: float) -> list[tuple[str, str]]:
        """Tasks whose tries have ended, with how ("" for not begun); waits a while for one."""
        ...

    def close(self) -> None:
        """End what is at work."""
        ...


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a task."""

    id: str  # Its name
    folder: Path | None  # Its files; None for one that failed, or whose files a store has
    value: Any = None  # What the function returned
    tries: int = 0  # How many it took
    failure: dict[str, Any] | None = None  # Of the last try of one that failed


def map(
    function: Function,
    items: Iterable[Any],
    folder: str | Path,
    *,
    ids: Sequence[str] | None = None,
    jobs: int | None = None,
    threads: int = 1,
    tries: int = TRIES,
    minutes: float | None = None,
    retry: bool = False,
    on: str = "local",
    gpu: float = 0.0,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Call a function for every item, in many processes, so that each call counts once.

    What is finished lies in the folder and is not done again: after Ctrl-C, a kill or a power cut
    the same call goes on. Several processes, also of machines that share the folder, may work in
    it at once. A call that fails is noted and harms no other.

    Args:
        function: ``function(item, folder)``, at the top of a module. It writes its files into the
            folder and returns what JSON can hold.
        items: What it is called with; whatever can be pickled.
        folder: Where the results go: ``shots/ID``. Or ``s3://BUCKET/PLACE`` (extra ``s3``), whose
            files :func:`gsfluent.sweep.fetch` brings here.
        ids: Names of the items, letters, digits, ``_`` and ``-``; digests of function and item
            when absent.
        jobs: Calls at a time; one per core when absent, of a Ray cluster for all of its cores.
        threads: Threads of a process.
        tries: How often a call is tried that a signal, a lost machine or want of memory ended.
            Other errors are final, since they would come again.
        minutes: Longest time of a call.
        retry: Try again what has failed finally.
        on: ``local``; ``slurm``: a job of the cluster for every call (extra ``slurm``); ``ray`` or
            ``ray=HOST:PORT``: a Ray cluster that runs (extra ``ray``).
        gpu: Part of a GPU that a call takes, at most 1; 0 for none. Calls share a GPU, each within
            its part of the memory; one that wants more is tried again on a whole one. A SLURM job
            has a whole one.
        progress: Called with (done, total, note), about once a second.

    Returns:
        One outcome per item, in their order.

    Raises:
        InputError: Two items of one name, or something out of range.
        RunError: Nothing can be started or written.
        KeyboardInterrupt: With what is kept.
    """
    items, place = list(items), opened(folder)
    names = _names(function, items, ids)
    for key, value in (("jobs", jobs), ("tries", tries), ("threads", threads)):
        if value is not None and value < 1:
            raise InputError(f"sweep: {key} is {value}", "give at least 1")
    if minutes is not None and not minutes > 0:
        raise InputError(f"sweep: minutes is {minutes}", "give a time above 0, or none")
    if not 0.0 <= gpu <= 1.0:
        raise InputError(f"sweep: gpu is {gpu}", "give the part of one that a call takes, 0 to 1")
    place.make()
    work = _Work(place, dict(zip(names, items, strict=True)), tries, progress)
    work.sort(retry=retry)
    for part in (gpu, 1.0):  # on a whole GPU what found too little memory on a part of one
        if not work.waiting:
            break
        engine = _engine(
            on, place.address, function, jobs=jobs, minutes=minutes, threads=threads, gpu=part
        )
        work.packed = 0.0 < part < 1.0
        try:
            work.through(engine)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(
                f"{str(stop) or 'interrupted by Ctrl-C'}\n  kept: {work.done} of {len(names)} in "
                f"{place.address}\n  resume: run the same command again"
            ) from stop
        finally:
            engine.close()
            place.tidy()
        work.waiting.extend(work.crowded)
    return work.outcomes()


def required(outcomes: list[Outcome], what: str, folder: Path) -> list[Outcome]:
    """What :func:`map` gives back, where every item is needed.

    Args:
        outcomes: What it gave back.
        what: That some could not be done, such as "searches failed".
        folder: Where the others are.

    Raises:
        RunError: Some failed.
    """
    failed = {o.id: o.failure["message"] for o in outcomes if o.failure is not None}
    if failed:
        name, message = next(iter(failed.items()))
        raise RunError(
            f"{len(failed)} {what}; {name}: {message}",
            f"the others, in {folder}", "run the same command again",
        )  # fmt: skip
    return outcomes


class _Work:
    """What is left to do, and what has become of the rest."""

    def __init__(
        self, place: SweepFolder, items: dict[str, Any], tries: int, progress: Progress | None
    ) -> None:
        self.place, self.items, self.tries, self.progress = place, items, tries, progress
        self.waiting: collections.deque[str] = collections.deque()
        self.held: set[str] = set()  # somebody else is at work on them
        self.packed = False  # whether several share a GPU
        self.crowded: list[str] = []  # they wait for a GPU of their own
        self.failed: dict[str, list[dict[str, Any]]] = {}
        self.done = 0
        self._began, self._before = time.monotonic(), 0

    def sort(self, *, retry: bool) -> None:
        """Find out what is done, what has failed and what is left."""
        done = self.place.done()
        self.done = self._before = sum(name in done for name in self.items)
        left = [name for name in self.items if name not in done]
        if retry:
            self.place.forgive(left)
        failures = self.place.failures()
        for name in left:
            if self._final(records := failures.get(name, [])):
                self.failed[name] = records
            else:
                self.waiting.append(name)
        self._tell()

    def through(self, engine: Engine) -> None:
        """Hand out everything that is left, until nothing is."""
        at_work, look = 0, time.monotonic()
        while self.waiting or self.held or at_work:
            while self.waiting and engine.room() > 0:
                name = self.waiting.popleft()
                if not self._found(name):  # by another driver, meanwhile
                    engine.start(name, self.items[name])
                    at_work += 1
            for name, state in engine.ended(_TICK):
                at_work -= 1
                self._take(name, state)
            if self.held and time.monotonic() - look >= _TICK:
                self._look_at_held()
                look = time.monotonic()
            self._tell()

    def outcomes(self) -> list[Outcome]:
        """One per task, in their order."""
        rows = self.place.rows([name for name in self.items if name not in self.failed])
        return [self._outcome(name, rows.get(name, {})) for name in self.items]

    def _outcome(self, name: str, row: dict[str, Any]) -> Outcome:
        if records := self.failed.get(name):
            return Outcome(name, None, tries=len(records), failure=records[-1])
        return Outcome(name, self.place.files(name), row.get("value"), int(row.get("tries", 1)))

    def _final(self, records: list[dict[str, Any]]) -> bool:
        return len(records) >= self.tries or any(not record["again"] for record in records)

    def _found(self, name: str) -> bool:
        """Whether a task is done, or has failed for good."""
        if self.place.is_done(name):
            self.done += 1
            return True
        records = self.place.failures(name).get(name, [])
        if self._final(records):
            self.failed[name] = records
            return True
        return False

    def _take(self, name: str, state: str) -> None:
        if state == DONE:
            self.done += 1
        elif state == FAILED:
            if not self._found(name):
                last = self.place.failures(name)[name][-1]
                crowded = self.packed and last.get("memory")
                (self.crowded if crowded else self.waiting).append(name)
        elif state:
            self.held.add(name)
        else:
            self.waiting.appendleft(name)

    def _look_at_held(self) -> None:
        """See what the others have made of what they hold."""
        for name in sorted(self.held):
            if self._found(name):
                self.held.discard(name)
        for name in self.place.abandoned(sorted(self.held)):
            self.held.discard(name)
            self.waiting.append(name)

    def _tell(self) -> None:
        left = len(self.items) - self.done - len(self.failed)
        fresh = self.done - self._before
        words = [f"{len(self.failed)} failed"] if self.failed else []
        if fresh and left:
            seconds = (time.monotonic() - self._began) / fresh * left
            words.append(f"about {_span(seconds)} left")
        report_progress(
            self.progress, self.done + len(self.failed), len(self.items), ", ".join(words)
        )


def _span(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _names(function: Function, items: Sequence[Any], ids: Sequence[str] | None) -> list[str]:
    """Names of the tasks.

    Raises:
        InputError: Not one name an item.
    """
    if ids is None:
        from gsfluent.results.store import fingerprint  # costs torch, which names given do not

        home = f"{function.__module__}.{function.__qualname__}"
        names = [fingerprint(home, item) for item in items]
    else:
        names = list(ids)
    if len(names) != len(items) or len(set(names)) != len(names):
        raise InputError(
            f"sweep: {len(set(names))} names for {len(items)} items",
            "every item needs a name of its own; leave equal items out",
        )
    for name in names:
        if not _NAME.fullmatch(name):
            raise InputError(
                f"sweep: {name!r} is no name of a folder", "letters, digits, _ and - will do"
            )
    return names


def _engine(
    on: str,
    root: str | Path,
    function: Function,
    *,
    jobs: int | None,
    minutes: float | None,
    threads: int,
    gpu: float,
) -> Engine:
    """What places the tasks.

    Raises:
        InputError: No such engine, or not here.
    """
    kind, _, address = on.partition("=")
    if kind == "ray":
        from gsfluent.sweep.ray_pool import RayPool

        return RayPool(
            root, function, jobs=jobs, minutes=minutes, threads=threads, gpu=gpu,
            address=address or "auto",
        )  # fmt: skip
    jobs = jobs or os.cpu_count() or 1
    if on == "local":
        return LocalPool(root, function, jobs=jobs, minutes=minutes, threads=threads, gpu=gpu)
    if on == "slurm":
        from gsfluent.sweep.slurm import SlurmPool

        return SlurmPool(root, function, jobs=jobs, minutes=minutes, threads=threads, gpu=gpu)
    raise InputError(f"--on {on}: no such engine", "give local, slurm, ray or ray=HOST:PORT")
