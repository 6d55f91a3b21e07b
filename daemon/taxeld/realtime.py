"""What makes a loop keep its time: no collector, memory that stays, a scheduler that comes first.

What is not permitted is not an error: `/taxeld/health` says what was granted.
"""

import ctypes
import gc
import os
import sys
from dataclasses import dataclass

SWITCH_S = 0.0005  # another thread gives the interpreter back after that long
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # mlockall(2)


@dataclass(frozen=True, slots=True)
class RealTime:
    """What was granted."""

    fifo: int = 0  # SCHED_FIFO priority; 0: not permitted, or not asked for
    locked: bool = False  # memory stays in RAM once it has been touched
    gc_frozen: bool = False
    switch_us: float = 0.0


def enter(priority: int) -> RealTime:
    """Make the calling thread, warmed up, a real-time one. `priority`: of SCHED_FIFO, 1..99; 0: the
    scheduler and memory are left as they are.

    From here on the cyclic collector is off: nothing that runs in the loop makes cycles.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH_S)
    fifo = priority if priority and _fifo(priority) else 0
    locked = bool(priority) and _lock()
    return RealTime(fifo, locked, gc_frozen=True, switch_us=SWITCH_S * 1e6)


def leave() -> None:
    """Let the interpreter collect again."""
    gc.enable()
    gc.unfreeze()


def _fifo(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError:
        return False
    return True


def _lock() -> bool:
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        return bool(libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0)
    except (OSError, AttributeError):
        return False
