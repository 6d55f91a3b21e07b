"""When the loop's passes are due, who ends a wait, what is a step of the clock, and what a loop in
real time is granted."""

import contextlib
import fcntl
import gc
import os
import resource
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.service import realtime
from taxeld.service.clock import IDLE_S, Ready, Ticker, WallClock, wait
from tests.rig.clocks import Clock
from tests.rig.processes import python

SOON_S = 20.0  # a wait that an input ends is over long before
HOUR_S = 3600.0


def by_the_clock(ticker: Ticker, clock: Clock, *, busy: bool = True) -> float:
    """Sleep until the next pass is due; → when it begins."""
    clock.now = max(clock.now, ticker.until(busy=busy))
    return ticker.begin()


@pytest.mark.parametrize(("busy", "every_s"), [(True, 0.01), (False, 0.05)])
def test_passes_keep_their_rate_without_drift(busy: bool, every_s: float) -> None:
    clock = Clock()
    ticker, times = Ticker(100.0, 0.05, clock=clock), []
    for k in range(1000):
        times.append(by_the_clock(ticker, clock, busy=busy))
        clock.now += 0.003 + 0.001 * (k % 5)  # work of varying length
    assert times == pytest.approx([every_s * (k + 1) for k in range(1000)])
    assert ticker.missed == 0


@pytest.mark.parametrize(
    ("stall_s", "missed"), [(0.0099, 0), (0.0101, 1), (0.025, 2), (3.001, 300)]
)
def test_missed_ticks_are_skipped_and_counted(stall_s: float, missed: int) -> None:
    """Whether the loop works too long, or the machine wakes it late."""
    clock = Clock()
    ticker = Ticker(100.0, clock=clock)
    by_the_clock(ticker, clock)
    clock.now += stall_s
    after = [by_the_clock(ticker, clock) for _ in range(3)]
    assert ticker.missed == missed
    assert after[1] - after[0] == pytest.approx(0.01)
    assert (after[0] / 0.01) == pytest.approx(round(after[0] / 0.01))
    clock.now = ticker.until(busy=True) + stall_s
    ticker.begin()
    assert ticker.missed == 2 * missed


def test_inputs_at_the_idle_pace_are_the_only_passes() -> None:
    """Scans at 20 Hz bring the estimates that are due at 20 Hz."""
    clock = Clock()
    ticker = Ticker(100.0, 0.05, clock=clock)
    by_the_clock(ticker, clock, busy=True)
    ticker.until(busy=False)
    for k in range(1, 100):
        clock.now = 0.05 * k + 0.004 * (k % 2)  # with some jitter
        ticker.begin()
        clock.now += 0.001  # work
        assert ticker.until(busy=False) > 0.05 * (k + 1) + 0.004


@given(
    rate_hz=st.floats(1.0, 1000.0),
    idle_s=st.floats(0.001, 1.0),
    early=st.lists(st.tuples(st.booleans(), st.floats(0.0, 1.0)), max_size=20),
)
def test_the_next_pass_is_a_tick_late_at_most_and_soon_however_slow_ticks_are(
    rate_hz: float, idle_s: float, early: list[tuple[bool, float]]
) -> None:
    """`early`: whether a pass is busy, and the share of the wait after which an input ends it."""
    clock = Clock()
    ticker, tick_s = Ticker(rate_hz, idle_s, clock=clock), min(1.0 / rate_hz, IDLE_S)
    for busy, share in early:
        began = clock.now
        until = ticker.until(busy=busy)
        most_s = tick_s if busy else max(min(idle_s, IDLE_S), tick_s) + tick_s
        assert 0.0 < until - began <= most_s + 1e-9
        clock.now = began + share * (until - began)
        ticker.begin()
    assert ticker.missed == 0


class Mute:
    """A device without a descriptor."""

    @staticmethod
    def fileno() -> int:
        return -1


def test_who_speaks_ends_the_wait_and_is_named() -> None:
    with contextlib.ExitStack() as pairs:
        (device, skin), (door, peer) = (
            [pairs.enter_context(end) for end in socket.socketpair()] for _ in range(2)
        )
        assert wait([device], door, time.monotonic() + 0.001) == Ready()
        skin.send(b"x")
        assert wait([device, Mute()], door, time.monotonic() + SOON_S) == Ready(device=True)
        peer.send(b"x")
        assert wait([None, device], door, time.monotonic() + SOON_S) == Ready(True, True)
        assert wait([Mute()], None, time.monotonic() + 0.001) == Ready()


def test_a_descriptor_of_any_number_can_be_waited_for() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with contextlib.ExitStack() as opened:
        device, skin = (opened.enter_context(end) for end in socket.socketpair())
        high = opened.enter_context(socket.socket(fileno=fcntl.fcntl(device, fcntl.F_DUPFD, 1200)))
        skin.send(b"x")
        assert wait([high], None, time.monotonic() + SOON_S) == Ready(device=True)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("by", [HOUR_S, -HOUR_S, 0.3, -0.3, 0.2])
def test_a_step_of_the_clock_is_seen_once_and_a_smaller_one_is_none(by: float) -> None:
    monotonic, wall = Clock(50.0), Clock(1e9)
    clock = WallClock(wall, monotonic)
    for passed_s, step in ((0.01, 0.0), (0.01, by), (30.0, 0.0)):  # a long tick is no step
        monotonic.now += passed_s
        wall.now += passed_s * (1.0 + 500e-6) + step  # it is slewed as well
        now, seen = clock.read()
        assert now == wall.now
        assert seen == pytest.approx(step if abs(step) > 0.25 else 0.0, abs=1e-5)


def test_a_reading_during_which_the_process_was_suspended_is_ignored() -> None:
    monotonic, wall = Clock(50.0), Clock(1e9)
    held_s = 0.0

    def held_up() -> float:
        monotonic.now += held_s
        wall.now += held_s
        return monotonic.now

    clock = WallClock(wall, held_up)
    held_s = 1.0
    assert clock.read()[1] == 0.0
    held_s = 0.0
    wall.now += HOUR_S
    assert clock.read()[1] == pytest.approx(HOUR_S, abs=1e-5)


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
        assert bool(int(status.split("VmLck:")[1].split()[0])) == granted.locked


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
