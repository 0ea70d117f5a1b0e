"""How large a picture may be to be ready in time, learnt from the pictures before it."""

from __future__ import annotations

import math
import threading

_MEMORY = 24.0  # pictures over which older measurements fade
_SMALLEST = 0.2  # of the full width: below, one recognises nothing


class Pace:
    """Fits ``seconds = fixed + slope * pixels`` to what was measured, recent pictures most.

    Args:
        fixed: First guess of the part that does not depend on the size [s].
        slope: First guess of the part that does [s per pixel].
    """

    def __init__(self, fixed: float = 0.05, slope: float = 4e-7) -> None:
        # the guess counts as two pictures, one small and one large
        self._lock = threading.Lock()
        self._sums = [0.0] * 5
        for pixels in (2e4, 1e6):
            self._add(pixels, fixed + slope * pixels, 1.0)

    def _add(self, pixels: float, seconds: float, weight: float) -> None:
        values = (1.0, pixels, pixels**2, seconds, pixels * seconds)
        self._sums = [old * weight + value for old, value in zip(self._sums, values, strict=True)]

    def measured(self, pixels: int, seconds: float) -> None:
        """Learn that a picture of so many pixels took so long."""
        with self._lock:
            self._add(float(pixels), seconds, 1.0 - 1.0 / _MEMORY)

    def seconds(self, pixels: float) -> float:
        """Expected time for a picture of ``pixels`` [s]."""
        fixed, slope = self._fit()
        return fixed + slope * pixels

    def scale(self, width: int, height: int, budget: float) -> float:
        """Factor on the picture's sides with which it is expected within ``budget`` seconds.

        A machine whose fixed part alone takes longer gets the size at which the pixels cost as much
        again: still smaller pictures would be worse to look at and hardly faster.

        Returns:
            Between 0.2 and 1.
        """
        fixed, slope = self._fit()
        allowed = max(budget - fixed, fixed)
        share = math.sqrt(allowed / (slope * width * height))
        return min(1.0, max(_SMALLEST, share))

    def _fit(self) -> tuple[float, float]:
        with self._lock:
            n, x, xx, y, xy = self._sums
        spread = xx - x * x / n
        slope = (xy - x * y / n) / spread if spread > 1e-6 * xx else y / x
        slope = min(max(slope, 1e-10), y / x)
        return max(0.0, (y - slope * x) / n), slope
