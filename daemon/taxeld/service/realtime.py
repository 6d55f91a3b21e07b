"""Settings that keep a loop in time: no collector, memory that stays, a priority scheduler.

A setting that is not permitted is not an error: `/taxeld/health` reports the granted ones.
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
SWITCH_S = 0.0005  # time after which another thread gives the interpreter back
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # mlockall(2)


@dataclass(frozen=True, slots=True)
class RealTime:
    """The granted settings."""

    fifo: int = 0  # SCHED_FIFO priority; 0: not permitted, or not asked for
    locked: bool = False  # memory stays in RAM once it has been touched


class Collector:
    """The cyclic collector, run when it disturbs nothing.

    The work of a tick makes no cycles, but drivers make some when a device is opened or fails to
    open: python-can leaves about 36 objects an attempt.
    """

    def __init__(self) -> None:
        self._attempts = 0
        self._next_s = -math.inf

    def tick(self, now_s: float, attempts: int, *, pressed: bool) -> bool:
        """Run the collector if due; → whether it ran. `attempts`: to open the device, since start;
        `pressed`: whether the skin is touched."""
        if attempts == self._attempts and (pressed or now_s < self._next_s):
            return False
        self._attempts = attempts
        self._next_s = now_s + COLLECT_S
        gc.collect()
        return True


def trim() -> None:
    """Return memory freed after loading to the system; to be called before the warm-up."""
    with contextlib.suppress(AttributeError):  # the C library has no malloc_trim
        ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def thread(priority: int) -> Iterator[RealTime]:
    """Make the calling thread, already warmed up, a real-time thread; → the granted settings.

    `priority` is of SCHED_FIFO, 1..99; with 0 the scheduler and memory are left unchanged. The
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
        yield RealTime(fifo, locked)
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
    """Lock memory, unless a limit is set: allocation beyond it would fail."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        return False
    try:
        locked = ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT)
    except (OSError, AttributeError):
        return False
    return bool(locked == 0)
