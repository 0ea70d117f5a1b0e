"""Drives a live session in a thread of its own, as fast as real time asks and the machine allows.

The thread simulates one frame at a time and hands it out whole; whoever draws takes the newest and
never waits. Pokes are put in a queue and done between frames. While everything is at rest the
thread sleeps and the clock of the simulation stands. The step of the simulation is never touched:
where the machine is too slow, less is simulated per second, and the real-time factor says so.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.config import Shot
from gsfluent.errors import GsfluentError, InputError, RunError
from gsfluent.live.recording import Recording
from gsfluent.live.session import LiveSession
from gsfluent.results.frames import SavedFrame

_log = logging.getLogger(__name__)

KEPT_BYTES = 1 << 30
"""Memory for frames that can still be looked at."""
MOST_FRAMES = 5_000
"""Frames after which numbers begin at 0 again, so that a long session needs no more memory."""
AUTOMATIC = (1.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0)
"""Slow motions among which the automatic one chooses."""
WINDOW = 1.0
"""Wall seconds over which speeds are averaged."""
AT_REST, RUNNING, FAILED, PAUSED = "at rest", "running", "failed", "paused"


@dataclasses.dataclass(frozen=True)
class Status:
    """What a player is doing.

    Attributes:
        state: ``at rest``, ``running``, ``paused`` or ``failed``.
        time: Simulated time [s].
        real_time: Simulated seconds per wall second over the last second of work; None at rest.
        wanted: What slow motion asks for: ``1 / slow``.
        frames_per_second: Simulated frames per wall second, likewise.
        latency: Wall seconds from the start of a frame until it can be drawn; None before one.
        particles: Material points.
        dropped: Points that left because they were far away.
        message: The last thing that went wrong, or empty.
        recording: Frames in the recording, or None.
    """

    state: str
    time: float
    real_time: float | None
    wanted: float
    frames_per_second: float | None
    latency: float | None
    particles: int
    dropped: int
    message: str
    recording: int | None


class LivePlayer:
    """A session that runs by itself.

    Args:
        session: The session; nobody else may touch it from now on.
        shot: The shot of the scene, for recordings.
        clock: Wall seconds.
    """

    def __init__(
        self,
        session: LiveSession,
        shot: Shot | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.session, self.shot = session, shot
        self._clock = clock
        self._wake = threading.Condition()
        self._queue: collections.deque[tuple[Callable[[], Any], Future[Any]]] = collections.deque()
        self._frames: collections.OrderedDict[int, SavedFrame] = collections.OrderedDict()
        self._facts: dict[int, dict[str, Any]] = {}
        self._bytes = 0
        self._stop = self._paused = False
        self._message = ""
        self._speed: collections.deque[tuple[float, float, float]] = collections.deque()
        self._recording: Recording | None = None
        self.automatic = False
        self.count = self.revision = 0
        self._keep(session.frame())
        self._status = self._look()
        self._thread = threading.Thread(target=self._work, name="gsfluent-live", daemon=True)

    def start(self) -> LivePlayer:
        """Begin."""
        self._thread.start()
        return self

    def close(self) -> None:
        """End the thread after the frame in hand, and the recording."""
        with self._wake:
            self._stop = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=60.0)
        while self._queue:
            self._queue.popleft()[1].cancel()
        if self._recording is not None:
            self._finish_recording()

    # --- from any thread ---

    @property
    def status(self) -> Status:
        """What it is doing."""
        return self._status

    def frame(self, number: int) -> SavedFrame:
        """Frame ``number`` since the last reset.

        Raises:
            RunError: It is too old to be kept.
        """
        with self._wake:
            if number not in self._frames:
                raise RunError(f"frame {number} of the session is gone", "the newest frames")
            return self._frames[number]

    def facts(self, number: int) -> dict[str, Any]:
        """Figures of a frame since the last reset."""
        return self._facts.get(number, {})

    def wait_for_frame(self, seen: tuple[int, int], timeout: float) -> tuple[int, int]:
        """Wait until another frame than ``seen`` (revision and count) is there; returns which."""
        with self._wake:
            self._wake.wait_for(lambda: self._stop or (self.revision, self.count) != seen, timeout)
            return self.revision, self.count

    def do(self, act: Callable[[LiveSession], Any]) -> Future[Any]:
        """Do something to the session between two frames.

        Its result or error is in the future; an error a user can mend also becomes the status'
        message.
        """
        return self._enqueue(lambda: act(self.session))

    def reset(self) -> Future[Any]:
        """Back to the prepared object; ends a recording."""
        return self._enqueue(self._reset)

    def set_slow(self, slow: float | None) -> Future[Any]:
        """Slow motion; not while a recording is made, whose frames are evenly spaced.

        Args:
            slow: How many times slower; None lets it follow what the machine can do.
        """

        def act() -> None:
            if self._recording is not None:
                raise InputError("a recording has one speed", hint="end the recording first")
            self.automatic = slow is None
            if slow is not None:
                self.session.set_slow(slow)
            self._speed.clear()

        return self._enqueue(act)

    def _adapt(self) -> None:
        """More slow motion while frames come late, less while they wait, a step at a time.

        A frame of more slow motion has fewer steps; what does not depend on them remains.
        """
        if not self.automatic or self._recording is not None or len(self._speed) < 4:
            return
        busy = sum(ready for _, _, ready in self._speed) / len(self._speed)
        steps = [value for value in AUTOMATIC if value != self.session.slow]
        above = [value for value in steps if value > self.session.slow]
        below = [value for value in steps if value < self.session.slow]
        if busy > 1.2 / self.session.fps and above:
            self.session.set_slow(above[0])
        elif busy < 0.4 / self.session.fps and below:
            self.session.set_slow(below[-1])
        else:
            return
        self._speed.clear()
        self._status = self._look()

    def pause(self, paused: bool) -> Future[Any]:
        """Let the simulation stand, or go on; pokes are taken all the same."""

        def act() -> None:
            self._paused = paused
            if not paused:
                self._speed.clear()

        return self._enqueue(act)

    def record(self, out: Path) -> Future[Any]:
        """Reset, and write what happens from then on into a run folder."""

        def act() -> None:
            if self.shot is None:
                raise InputError("record: the session has no shot", hint="open a run or a shot")
            self._reset()
            self._recording = Recording(out, self.session, self.shot)

        return self._enqueue(act)

    def end_recording(self) -> Future[Any]:
        """Finish the recording; the future has its folder."""

        def act() -> Path:
            if self._recording is None:
                raise InputError(
                    "record: nothing is being recorded", hint="begin a recording first"
                )
            return self._finish_recording()

        return self._enqueue(act)

    def _enqueue(self, act: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        with self._wake:
            if self._stop:
                raise InputError("live: the session has ended", hint="open it again")
            self._queue.append((act, future))
            self._wake.notify_all()
        return future

    # --- in the thread ---

    def _work(self) -> None:
        try:
            self._loop()
        except Exception as error:  # nobody would hear of it otherwise
            _log.exception("live: the thread ended")
            self.session.failure = f"{type(error).__name__}: {error}"
            self._message = self.session.failure
            self._status = self._look()
            with self._wake:
                self._stop = True
                while self._queue:
                    self._queue.popleft()[1].set_exception(error)
                self._wake.notify_all()

    def _loop(self) -> None:
        with torch.no_grad(), _stream(self.session.device):
            while True:
                with self._wake:
                    self._wake.wait_for(lambda: self._stop or bool(self._queue) or not self._idle())
                    if self._stop:
                        return
                self._obey()
                if not self._idle():
                    self._one_frame()

    def _idle(self) -> bool:
        return self._paused or bool(self.session.failure) or self.session.at_rest

    def _obey(self) -> None:
        """Do what is in the queue."""
        while self._queue:
            act, future = self._queue.popleft()
            if not future.set_running_or_notify_cancel():
                continue
            error: Exception | None = None
            result = None
            try:
                result = act()
                self._message = ""
            except GsfluentError as problem:
                self._message, error = str(problem).split("\n")[0], problem
            except Exception as problem:
                _log.exception("live: a command failed")
                self._message = f"{type(problem).__name__}: {problem}"
                error = problem
            # who waits for it finds the status as it is then
            self._status = self._look()
            if error is None:
                future.set_result(result)
            else:
                future.set_exception(error)
            with self._wake:
                self._wake.notify_all()

    def _one_frame(self) -> None:
        """Simulate a frame, hand it out, and wait until the next one is due."""
        session, begun = self.session, self._clock()
        before = session.time
        try:
            frame = session.step()
            if frame is not None and self._recording is not None:
                self._recording.add(frame)
        except Exception as error:
            # the page must live on, and its user be told
            _log.exception("live: a frame failed")
            session.failure = f"{type(error).__name__}: {error}"
            frame = None
        if session.device.type == "cuda":
            torch.cuda.current_stream(session.device).synchronize()
        if frame is None:
            self._message = session.failure
            self._speed.clear()
            self._status = self._look()
            with self._wake:
                self._wake.notify_all()
            return
        ready = self._clock()
        self._keep(frame)
        due = begun + 1.0 / session.fps
        with self._wake:
            self._wake.notify_all()
            while not self._stop and not self._queue and (left := due - self._clock()) > 0.0:
                self._wake.wait(left)
        now = self._clock()
        self._speed.append((now - begun, session.time - before, ready - begun))
        while len(self._speed) > 1 and sum(wall for wall, _, _ in self._speed) > WINDOW:
            self._speed.popleft()
        self._status = self._look()
        if session.at_rest:
            self._speed.clear()
            self._status = self._look()
        self._adapt()

    def _reset(self) -> None:
        if self._recording is not None:
            self._finish_recording()
        self.session.reset()
        self._paused = False
        with self._wake:
            self._begin_anew()
        self._speed.clear()
        self._keep(self.session.frame())

    def _begin_anew(self) -> None:
        """Number frames from 0 again; those that were there are gone."""
        self._frames.clear()
        self._facts.clear()
        self._bytes = self.count = 0
        self.revision += 1

    def _finish_recording(self) -> Path:
        recording, self._recording = self._recording, None
        assert recording is not None
        return recording.close()

    def _keep(self, frame: SavedFrame) -> None:
        frame = dataclasses.replace(frame, index=self.count)
        with self._wake:
            if self.count >= MOST_FRAMES:
                self._begin_anew()
                frame = dataclasses.replace(frame, index=0)
            self._frames[self.count] = frame
            energy = frame.facts.get("energy", {})
            self._facts[self.count] = dict(frame.facts) | {"time": frame.time, "energy": energy}
            self._bytes += _size(frame)
            while self._bytes > KEPT_BYTES and len(self._frames) > 1:
                self._bytes -= _size(self._frames.popitem(last=False)[1])
            self.count += 1

    def _look(self) -> Status:
        session, speed = self.session, list(self._speed)
        wall, simulated = sum(s[0] for s in speed), sum(s[1] for s in speed)
        state = FAILED if session.failure else AT_REST if session.at_rest else RUNNING
        state = PAUSED if state == RUNNING and self._paused else state
        return Status(
            state=state,
            time=session.time,
            real_time=simulated / wall if wall > 0.0 else None,
            wanted=1.0 / session.slow,
            frames_per_second=len(speed) / wall if wall > 0.0 else None,
            latency=speed[-1][2] if speed else None,
            particles=session.run.matter.particles.count,
            dropped=session.dropped,
            message=self._message,
            recording=None if self._recording is None else len(self._recording.frames),
        )


@contextlib.contextmanager
def _stream(device: torch.device) -> Iterator[None]:
    """A stream of one's own on a GPU, so that pictures need not wait for the simulation."""
    if device.type != "cuda":
        yield
        return
    number = torch.cuda.current_device() if device.index is None else device.index
    torch.cuda.set_device(number)
    stream = torch.cuda.Stream(number)
    stream.wait_stream(torch.cuda.default_stream(number))
    with torch.cuda.stream(stream):
        yield


def _size(frame: SavedFrame) -> int:
    fields = [*vars(frame).values(), *vars(frame.gaussians).values()]
    return sum(f.numel() * f.element_size() for f in fields if isinstance(f, Tensor))
