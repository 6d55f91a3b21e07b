"""The clocks of a daemon in this process, set by hand."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

from taxeld.service import loop
from taxeld.service.clock import WallClock
from taxeld.service.loop import Daemon
from taxeld.source import sources

EPOCH_S = 1e9


class FakeTime:
    """`now_s` is what its monotonic clock says; its Unix time began at EPOCH_S."""

    def __init__(self) -> None:
        self.now_s = 0.0

    @contextmanager
    def installed(self) -> Iterator[None]:
        """In the place of the loop's and the sources' clocks; CPU time stays real."""
        fake = SimpleNamespace(
            time=lambda: EPOCH_S + self.now_s,
            monotonic=lambda: self.now_s,
            monotonic_ns=lambda: round(self.now_s * 1e9),
            perf_counter_ns=time.perf_counter_ns,
            thread_time_ns=time.thread_time_ns,
        )
        before = loop.time, sources.time
        loop.time = sources.time = fake
        try:
            yield
        finally:
            loop.time, sources.time = before

    def give(self, daemon: Daemon) -> None:
        """The daemon's own look at the Unix clock."""
        daemon.clock = WallClock(lambda: EPOCH_S + self.now_s, lambda: self.now_s)
