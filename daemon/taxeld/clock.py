"""The wall clock, and whether somebody set it.

Scans and poses are stamped with Unix time of arrival. When NTP or an operator steps that clock, the
monotonic clock beside it tells by how much; what is slewed, or smaller, is followed in silence.
"""

import time
from collections.abc import Callable

STEP_S = 0.25

Clock = Callable[[], float]


class WallClock:
    """Unix time, read once a tick."""

    def __init__(self, wall: Clock = time.time, monotonic: Clock = time.monotonic) -> None:
        self.steps = 0
        self._wall = wall
        self._monotonic = monotonic
        self._before = wall(), monotonic()

    def read(self) -> tuple[float, float]:
        """Unix time, and by how much it was stepped since the last reading, 0 where it was not."""
        before, wall, after = self._monotonic(), self._wall(), self._monotonic()
        was_wall, was_monotonic = self._before
        by = (wall - was_wall) - (before - was_monotonic)
        # when this process was put aside between the readings, `by` is of no use
        if after - before >= STEP_S:
            return wall, 0.0
        self._before = wall, before
        if abs(by) < STEP_S:
            return wall, 0.0
        self.steps += 1
        return wall, by
