"""When the loop's passes begin: at an arrival, or by the clock; and steps of the Unix clock.

Scans and poses are stamped with the Unix time of their arrival. When NTP or an operator steps that
clock, it gains or loses against the monotonic clock. Slewing and smaller steps count as no step.
"""

import math
import select
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

IDLE_S = 0.05  # longest time between passes
STEP_S = 0.25

Clock = Callable[[], float]


class Readable(Protocol):
    """An object with a descriptor; a negative one cannot be waited on."""

    def fileno(self) -> int: ...


class Ready(NamedTuple):
    """The inputs that may have arrivals."""

    device: bool = False
    door: bool = False


ALL = Ready(device=True, door=True)  # itself where the kernel could not say


def wait(devices: Sequence[Readable | None], door: Readable | None, until_s: float) -> Ready:
    """Sleep until one of the inputs is ready, at most until the monotonic time `until_s`."""
    numbers = [-1 if each is None else each.fileno() for each in (door, *devices)]
    poll = select.poll()  # `select` knows no descriptor over 1023
    for number in numbers:
        if number >= 0:
            poll.register(number, select.POLLIN)
    left_ms = max(0.0, 1e3 * (until_s - time.monotonic()))
    try:
        found = {number for number, _ in poll.poll(left_ms)}
    except OSError:  # it has no memory now
        time.sleep(min(1e-3 * left_ms, IDLE_S))
        return ALL
    return Ready(any(number in found for number in numbers[1:]), numbers[0] in found)


class Ticker:
    """Passes of a loop on a monotonic clock: one tick after the last pass while it is busy, else
    later. Ticks are accumulated, so their rate does not drift; missed ticks are skipped and
    counted, never made up for."""

    def __init__(
        self, rate_hz: float, idle_s: float = IDLE_S, clock: Clock = time.monotonic
    ) -> None:
        """`rate_hz`: rate of the ticks; `idle_s`: time between passes while idle."""
        self.missed = 0  # ticks missed by long work or a late machine
        self._period_s = 1.0 / rate_hz
        self._tick_s = min(self._period_s, IDLE_S)
        self._idle_s = max(min(idle_s, IDLE_S), self._tick_s)
        self._clock = clock
        self._began_s = self._until_s = clock()
        self._was_woken = False

    def until(self, *, busy: bool) -> float:
        """A pass is over; → the time when the next one is due. `busy`: whether work or input is
        pending."""
        self._skip(self._began_s)
        # After an arrival the wait is a tick longer, so that input at this pace wakes the loop.
        idle_s = self._idle_s + (self._tick_s if self._was_woken else 0.0)
        self._until_s = self._began_s + (self._tick_s if busy else idle_s)
        return self._until_s

    def begin(self) -> float:
        """A pass begins, at its time or at an arrival; → the time."""
        now = self._clock()
        self._was_woken = now < self._until_s
        self._began_s = now
        if not self._was_woken:
            self._skip(self._until_s)
        return now

    def _skip(self, since_s: float) -> None:
        """The pass began at the last tick, counted from `since_s`."""
        missed = math.floor((self._clock() - since_s) / self._period_s)
        self.missed += missed
        self._began_s = since_s + missed * self._period_s


class WallClock:
    """Unix time, read once a tick."""

    def __init__(self, wall: Clock = time.time, monotonic: Clock = time.monotonic) -> None:
        self._wall, self._monotonic = wall, monotonic
        self._before = wall(), monotonic()

    def read(self) -> tuple[float, float]:
        """Unix time, and the step since the last reading [s]; 0 without a step."""
        before, wall, after = self._monotonic(), self._wall(), self._monotonic()
        # if the process was stopped between the readings, they do not belong together
        if after - before >= STEP_S:
            return wall, 0.0
        by = wall - self._before[0] - (before - self._before[1])
        self._before = wall, before
        return wall, by if abs(by) >= STEP_S else 0.0
