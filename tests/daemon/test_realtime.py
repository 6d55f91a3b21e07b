"""What a real-time loop is granted, and that it leaves the interpreter as it was."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld import realtime


def test_everything_is_as_before_once_the_loop_has_ended() -> None:
    scheduler, switch_s = os.sched_getscheduler(0), sys.getswitchinterval()
    with pytest.raises(ZeroDivisionError), realtime.thread(20):  # noqa: PT012
        assert not gc.isenabled()
        assert sys.getswitchinterval() == pytest.approx(realtime.SWITCH_S)
        _ = 1 / 0
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert sys.getswitchinterval() == pytest.approx(switch_s)
    assert os.sched_getscheduler(0) == scheduler


def test_what_is_said_to_be_granted_is_what_the_kernel_says() -> None:
    with realtime.thread(7) as granted:
        policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        assert (policy == os.SCHED_FIFO) == bool(granted.fifo)
        assert os.sched_getparam(0).sched_priority == granted.fifo
        status = Path("/proc/self/status").read_text(encoding="ascii")
        locked_kb = int(status.split("VmLck:")[1].split()[0])
        assert bool(locked_kb) == granted.locked


def test_nothing_is_asked_of_the_kernel_with_priority_0() -> None:
    with realtime.thread(0) as granted:
        assert (granted.fifo, granted.locked) == (0, False)
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_what_is_refused_is_reported_and_stops_nothing() -> None:
    """As another user, with no right to either."""
    code = (
        "import os, resource\n"
        "from taxeld import realtime\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))\n"
        "os.getuid() or os.setuid(65534)\n"
        "with realtime.thread(20) as granted: print(granted.fifo, granted.locked)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "0 False\n"
