"""The Unix clock, and steps of it.

Scans and poses are stamped with the Unix time of their arrival. When NTP or an operator steps that
clock, it gains or loses against the monotonic clock. Slewing and smaller steps count as no step.
"""

import time
from collections.abc import Callable

STEP_S = 0.25

Clock = Callable[[], float]


def is_step(by: float) -> bool:
    """Whether a clock that has gained `by` seconds was stepped."""
    return abs(by) >= STEP_S


class WallClock:
    """Unix time, read once a tick."""

    def __init__(self, wall: Clock = time.time, monotonic: Clock = time.monotonic) -> None:
        self.steps = 0
        self._wall = wall
        self._monotonic = monotonic
        self._before = wall(), monotonic()

    def read(self) -> tuple[float, float]:
        """Unix time, and the step since the last reading [s]; 0 without a step."""
        before, wall, after = self._monotonic(), self._wall(), self._monotonic()
        was_wall, was_monotonic = self._before
        by = (wall - was_wall) - (before - was_monotonic)
        # the process was stopped between the readings, so they do not belong together
        if after - before >= STEP_S:
            return wall, 0.0
        self._before = wall, before
        if not is_step(by):
            return wall, 0.0
        self.steps += 1
        return wall, by
