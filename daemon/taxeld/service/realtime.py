"""What makes a loop keep its time: no collector, memory that stays, a scheduler that comes first.

What is not permitted is not an error: `/taxeld/health` says what was granted.
"""

import contextlib
import ctypes
import gc
import math
import os
import resource
import sys
from collections.abc import Iterator
from dataclasses import dataclass

COLLECT_S = 60.0
SWITCH_S = 0.0005  # another thread gives the interpreter back after that long
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # mlockall(2)


@dataclass(frozen=True, slots=True)
class RealTime:
    """What was granted."""

    fifo: int = 0  # SCHED_FIFO priority; 0: not permitted, or not asked for
    locked: bool = False  # memory stays in RAM once it has been touched
    gc_frozen: bool = False
    switch_us: float = 0.0


class Collector:
    """The cyclic collector, run when that disturbs nobody.

    What a tick does makes no cycles, but drivers do when a device is opened, in vain or not:
    python-can leaves some 36 objects an attempt.
    """

    def __init__(self) -> None:
        self._attempts = 0
        self._next_s = -math.inf

    def tick(self, now_s: float, attempts: int, *, pressed: bool) -> bool:
        """Whether it has run. `attempts`: to open the device, since start; `pressed`: the skin."""
        if attempts == self._attempts and (pressed or now_s < self._next_s):
            return False
        self._attempts = attempts
        self._next_s = now_s + COLLECT_S
        gc.collect()
        return True


def trim() -> None:
    """Give the system back what loading has left free; to be done before memory is warmed up."""
    with contextlib.suppress(AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def thread(priority: int) -> Iterator[RealTime]:
    """Make the calling thread, warmed up, a real-time one; → what was granted.

    `priority` is of SCHED_FIFO, 1..99; with 0 the scheduler and memory are left as they are. The
    cyclic collector does not run by itself meanwhile (see `Collector`).
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    fifo = priority if priority and _schedule(_FIFO, priority) else 0
    locked = bool(priority) and _lock()
    try:
        yield RealTime(fifo, locked, gc_frozen=True, switch_us=SWITCH_S * 1e6)
    finally:
        if locked:
            ctypes.CDLL(None).munlockall()
        if fifo:
            _schedule(os.SCHED_OTHER, 0)
        sys.setswitchinterval(before_s)
        gc.enable()
        gc.unfreeze()


_FIFO = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK


def _schedule(policy: int, priority: int) -> bool:
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError:
        return False
    return True


def _lock() -> bool:
    """Only where no limit is set, behind which memory could no longer be had at all."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        return False
    try:
        locked = ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT)
    except (OSError, AttributeError):
        return False
    return bool(locked == 0)
