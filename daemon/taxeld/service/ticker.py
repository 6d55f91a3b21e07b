"""When the loop's passes begin: at an arrival, or by the clock."""

import math
import select
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

IDLE_S = 0.05  # longest time between passes


class Readable(Protocol):
    """An object with a descriptor; a negative one cannot be waited on."""

    def fileno(self) -> int: ...


class Ready(NamedTuple):
    """The inputs that may have arrivals."""

    device: bool = False
    door: bool = False


ALL = Ready(device=True, door=True)


def wait(devices: Sequence[Readable | None], door: Readable | None, until_s: float) -> Ready:
    """Sleep until one of the inputs is ready, at most until the monotonic time `until_s`."""
    numbers = [-1 if each is None else each.fileno() for each in (door, *devices)]
    poll = select.poll()  # `select` knows no descriptor over 1023
    for number in numbers:
        if number >= 0:
            poll.register(number, select.POLLIN)
    left_ms = max(0.0, 1e3 * (until_s - time.monotonic()))
    found = {number for number, _ in poll.poll(left_ms)}
    return Ready(any(number in found for number in numbers[1:]), numbers[0] in found)


class Ticker:
    """Passes of a loop on a monotonic clock: one tick after the last pass while it is busy, else
    later. Ticks are accumulated, so their rate does not drift; missed ticks are skipped and
    counted, never made up for."""

    def __init__(
        self, rate_hz: float, idle_s: float = IDLE_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`rate_hz`: rate of the ticks; `idle_s`: time between passes while idle."""
        self.period_s = 1.0 / rate_hz
        self.missed = 0  # ticks missed by long work or a late machine
        self._tick_s = min(self.period_s, IDLE_S)
        self._idle_s = min(idle_s, IDLE_S)
        self._clock = clock
        self._began_s = self._until_s = clock()
        self._was_woken = False

    def until(self, *, busy: bool) -> float:
        """A pass is over; → the time when the next one is due. `busy`: whether work or input is
        pending."""
        now = self._clock()
        late = math.floor((now - self._began_s) / self.period_s)
        self.missed += late
        self._began_s += late * self.period_s
        if busy:
            self._until_s = self._began_s + self._tick_s
        else:
            # After an arrival the wait is a tick longer, so that input at this pace wakes the loop.
            slack_s = self._tick_s if self._was_woken else 0.0
            self._until_s = self._began_s + max(self._idle_s, self._tick_s) + slack_s
        return self._until_s

    def begin(self) -> float:
        """A pass begins, at its time or at an arrival; → the time."""
        now = self._clock()
        self._was_woken = now < self._until_s
        self._began_s = now
        if not self._was_woken:
            late = math.floor((now - self._until_s) / self.period_s)
            self.missed += late
            self._began_s = self._until_s + late * self.period_s
        return now
