"""Clocks of a test, and waiting by the real one."""

import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = 180.0  # of a test for a process, on a busy machine


class Clock:
    """Stands still until it is set; `now` in seconds."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds


def until(holds: Callable[[], Any], meanwhile: Callable[[], object] = lambda: None) -> Any:
    """The value of `holds` once it is true; `meanwhile` is called each two milliseconds."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := holds()):
        assert time.monotonic() < deadline, "waited in vain"
        meanwhile()
        time.sleep(0.002)
    return found
