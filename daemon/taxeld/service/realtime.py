"""Settings that keep a loop in time: no collector, memory that stays, a priority scheduler.

A setting that is not permitted is not an error: `/taxeld/health` reports the granted ones.
"""

import contextlib
import ctypes
import gc
import os
import resource
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SWITCH_S = 0.0001  # time after which another thread gives the interpreter back
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # mlockall(2)


@dataclass(frozen=True, slots=True)
class RealTime:
    """The granted settings."""

    fifo: int = 0  # SCHED_FIFO priority; 0: not permitted, or not asked for
    locked: bool = False  # memory stays in RAM once it has been touched


def trim() -> None:
    """Return memory freed after loading to the system; to be called before the warm-up."""
    with contextlib.suppress(AttributeError):  # the C library has no malloc_trim
        ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def thread(priority: int) -> Iterator[RealTime]:
    """Make the calling thread, already warmed up, a real-time thread; → the granted settings.

    `priority` is of SCHED_FIFO, 1..99; with 0 the scheduler and memory are left unchanged. The
    process's other threads get the priority below it: one of ordinary priority would keep the
    interpreter from the loop for as long as other processes keep the processor from it. The cyclic
    collector does not run by itself meanwhile.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    fifo = priority if priority and _schedule(_FIFO, priority) else 0
    threads = [int(task.name) for task in Path("/proc/self/task").iterdir()] if fifo else []
    for each in set(threads) - {threading.get_native_id()}:
        _schedule(_FIFO, max(priority - 1, 1), each)
    locked = bool(priority) and _lock()
    try:
        yield RealTime(fifo, locked)
    finally:
        if locked:
            ctypes.CDLL(None).munlockall()
        for each in threads:
            _schedule(os.SCHED_OTHER, 0, each)
        sys.setswitchinterval(before_s)
        gc.enable()
        gc.unfreeze()


_FIFO = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK


def _schedule(policy: int, priority: int, thread: int = 0) -> bool:
    """`thread`: its number in the kernel; 0: the calling one."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, policy, os.sched_param(priority))
        return True
    return False


def _lock() -> bool:
    """Lock memory, unless a limit is set: allocation beyond it would fail."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        return False
    return bool(ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0)
