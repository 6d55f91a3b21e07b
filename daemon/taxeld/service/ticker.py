"""Deadlines at a fixed rate."""

import time
from collections.abc import Callable

REST_S = 0.02  # at a time, where ticks are slow


class Ticker:
    """Deadlines at a fixed rate on a monotonic clock. They are accumulated, so the rate does not
    drift; those that have passed are skipped and counted, never made up for."""

    def __init__(
        self,
        rate_hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        idle: Callable[[float], None] = lambda _: None,
    ) -> None:
        """`idle` is called with the time, now and then, in ticks that are longer than 2 REST_S."""
        self.period_s = 1.0 / rate_hz
        self.missed = 0
        self._clock = clock
        self._sleep = sleep
        self._idle = idle
        self._deadline = clock() + self.period_s

    def wait(self) -> float:
        """Sleep to the next deadline; → the time."""
        now = self._clock()
        late = int((now - self._deadline) // self.period_s) + 1 if now > self._deadline else 0
        self.missed += late
        self._deadline += late * self.period_s
        while self._deadline - now > 2.0 * REST_S:
            self._sleep(REST_S)
            now = self._clock()
            self._idle(now)
        self._sleep(max(0.0, self._deadline - self._clock()))
        self._deadline += self.period_s
        return self._clock()

    def left_s(self) -> float:
        """Until the next deadline; negative where it has passed."""
        return self._deadline - self._clock()
