"""Which frame a moment of watching shows."""

from __future__ import annotations

import time
from collections.abc import Callable


class Playback:
    """A clock that runs over the frames.

    Frames are skipped rather than time stretched, so that the speed asked for is the speed seen,
    however slowly pictures come.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.playing = False
        self.loop = True
        self.speed = 1.0
        self._start = 0.0
        self._first = 0.0

    def play(self, index: int) -> None:
        """Start, or go on, from frame ``index``."""
        self._start, self._first, self.playing = self._clock(), float(index), True

    def pause(self) -> None:
        """Stop."""
        self.playing = False

    def index(self, count: int, fps: float) -> int:
        """Frame of this moment among ``count`` frames; pauses by itself at the end of the last."""
        passed = (self._clock() - self._start) * fps * self.speed
        index = int(self._first + passed)
        if index < count:
            return max(0, index)
        if self.loop:
            return index % count
        self.playing = False
        return count - 1

    def set_speed(self, speed: float, index: int) -> None:
        """Change the speed without a jump; ``index`` is the frame shown now."""
        self.speed = speed
        if self.playing:
            self.play(index)
