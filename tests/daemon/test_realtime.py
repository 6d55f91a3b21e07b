"""What a real-time loop is granted, and that it leaves the interpreter as it was."""

import errno
import gc
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.layout import read as layouts
from taxeld.service import realtime
from taxeld.source.opening import open_source
from tests.rig.processes import python


def test_a_daemon_loads_no_library_that_it_has_no_use_for() -> None:
    """Each takes start-up time and memory."""
    code = (
        "import sys, taxeld.service.loop\n"
        "unwanted = {'asyncio', 'ssl', 'email', 'can', 'torch', 'matplotlib', 'zmq'}\n"
        "print(*(unwanted & {*sys.modules}))"
    )
    assert python(code).stdout.split() == []


@pytest.fixture
def helper() -> Iterator[int]:
    """The kernel's number of another thread."""
    ends = threading.Event()
    thread = threading.Thread(target=ends.wait)
    thread.start()
    yield thread.native_id or 0
    ends.set()
    thread.join()


def test_everything_is_as_before_once_the_loop_has_ended(helper: int) -> None:
    before = [os.sched_getscheduler(thread) for thread in (0, helper)]
    switch_s = sys.getswitchinterval()
    with pytest.raises(ZeroDivisionError), realtime.thread(20):  # noqa: PT012
        assert not gc.isenabled()
        assert sys.getswitchinterval() == pytest.approx(realtime.SWITCH_S)
        _ = 1 / 0
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert sys.getswitchinterval() == pytest.approx(switch_s)
    assert [os.sched_getscheduler(thread) for thread in (0, helper)] == before


def test_what_is_said_to_be_granted_is_what_the_kernel_says(helper: int) -> None:
    """A helper of ordinary priority would keep the interpreter from the loop on a busy machine."""
    with realtime.thread(7) as granted:
        policy = [os.sched_getscheduler(k) & ~os.SCHED_RESET_ON_FORK for k in (0, helper)]
        assert [each == os.SCHED_FIFO for each in policy] == [bool(granted.fifo)] * 2
        levels = [os.sched_getparam(k).sched_priority for k in (0, helper)]
        assert levels == ([7, 6] if granted.fifo else [0, 0])
        status = Path("/proc/self/status").read_text(encoding="ascii")
        locked_kb = int(status.split("VmLck:")[1].split()[0])
        assert bool(locked_kb) == granted.locked


def test_what_is_refused_is_reported_and_stops_nothing() -> None:
    """As another user, with no right to either."""
    code = (
        "import os, resource\n"
        "from taxeld.service import realtime\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))\n"
        "os.getuid() or os.setuid(65534)\n"
        "with realtime.thread(20) as granted: print(granted.fifo, granted.locked)\n"
    )
    assert python(code).stdout == "0 False\n"


class Unplugged(can.BusABC):
    """A driver that leaves objects which refer to each other, as python-can's own do."""

    def __init__(self, *_: object, **__: object) -> None:
        self.me = [self]
        raise OSError(errno.ENODEV, "No such device")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


def test_a_device_that_is_away_for_long_costs_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("can.interface._get_class_for_interface", lambda _: Unplugged)
    skin = layouts.load("cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015")
    config = SourceConfig(kind="can", interface="virtual", channel="away")
    with realtime.thread(0):
        source = open_source(config, skin, wait=True)
        collector = realtime.Collector()
        sizes = []
        for second in range(200):
            source.poll(float(second))
            opened = source.counters.unopened + source.counters.reopened
            collector.tick(float(second), opened, pressed=True)
            sizes.append(len(gc.get_objects()))
        assert source.counters.unopened >= 200
        assert max(sizes[100:]) - sizes[10] < 20
        source.close()


@pytest.mark.check
def test_the_collector_runs_once_a_minute_while_nothing_is_pressed() -> None:
    collector = realtime.Collector()
    ran = [k for k in range(400) if collector.tick(float(k), 0, pressed=100 <= k < 200)]
    assert ran == [0, 60, 200, 260, 320, 380]
