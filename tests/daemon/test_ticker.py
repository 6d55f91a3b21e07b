"""When the loop's passes are due, on a fake clock."""

import contextlib
import fcntl
import resource
import socket
import time

import pytest

from taxeld.service.clock import IDLE_S, Ready, Ticker, wait

SOON_S = 20.0  # a wait that an input ends is over long before


class FakeClock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds


def by_the_clock(ticker: Ticker, clock: FakeClock, *, busy: bool = True) -> float:
    """Sleep until the next pass is due; → when it begins."""
    clock.now = max(clock.now, ticker.until(busy=busy))
    return ticker.begin()


def test_ticks_keep_the_rate_without_drift() -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock=clock)
    times = []
    for k in range(1000):
        times.append(by_the_clock(ticker, clock))
        clock.now += 0.003 + 0.001 * (k % 5)  # work of varying length
    assert times == pytest.approx([0.01 * (k + 1) for k in range(1000)])
    assert ticker.missed == 0


@pytest.mark.parametrize(
    ("stall_s", "missed"), [(0.0099, 0), (0.0101, 1), (0.025, 2), (3.001, 300)]
)
def test_missed_ticks_are_skipped_and_counted(stall_s: float, missed: int) -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock=clock)
    by_the_clock(ticker, clock)
    clock.now += stall_s
    after = [by_the_clock(ticker, clock) for _ in range(3)]
    assert ticker.missed == missed
    assert after[1] - after[0] == pytest.approx(0.01)
    assert (after[0] / 0.01) == pytest.approx(round(after[0] / 0.01))


def test_a_machine_that_wakes_the_loop_late_is_counted() -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock=clock)
    for late_s, missed in ((0.009, 0), (0.031, 3)):
        clock.now = ticker.until(busy=True) + late_s
        ticker.begin()
        assert ticker.missed == missed


def test_the_next_pass_comes_a_tick_after_one_that_an_input_has_begun() -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock=clock)
    ticker.until(busy=True)
    clock.now = 0.0095
    ticker.begin()
    assert ticker.until(busy=True) == pytest.approx(0.0195)
    assert ticker.missed == 0


def test_where_nothing_is_under_way_ticks_are_slept_through_and_not_missed() -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, 0.05, clock=clock)
    by_the_clock(ticker, clock, busy=False)
    times = [by_the_clock(ticker, clock, busy=False) for _ in range(20)]
    assert times == pytest.approx([times[0] + 0.05 * k for k in range(20)])
    assert ticker.missed == 0


def test_inputs_at_the_idle_pace_are_the_only_passes() -> None:
    """Scans at 20 Hz bring the estimates that are due at 20 Hz."""
    clock = FakeClock()
    ticker = Ticker(100.0, 0.05, clock=clock)
    by_the_clock(ticker, clock, busy=True)
    ticker.until(busy=False)
    for k in range(1, 100):
        clock.now = 0.05 * k + 0.004 * (k % 2)  # with some jitter
        ticker.begin()
        clock.now += 0.001  # work
        assert ticker.until(busy=False) > 0.05 * (k + 1) + 0.004


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0])
@pytest.mark.parametrize("idle_s", [0.01, 0.05])
def test_what_is_due_while_nothing_comes_is_at_most_a_tick_late(
    rate_hz: float, idle_s: float
) -> None:
    clock = FakeClock()
    ticker = Ticker(rate_hz, idle_s, clock=clock)
    tick_s = 1.0 / rate_hz
    for woken_s in (0.0, 0.3 * idle_s, 0.9 * idle_s):
        began = clock.now = ticker.until(busy=False) - woken_s
        ticker.begin()
        assert ticker.until(busy=False) - began <= max(idle_s, tick_s) + tick_s + 1e-9


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_slow_ticks_leave_nobody_alone_for_long(rate_hz: float) -> None:
    """Peers are served and a device is tended however slow the loop may be."""
    clock = FakeClock()
    ticker = Ticker(rate_hz, 1.0, clock=clock)
    for busy in (True, False, True, False):
        began = by_the_clock(ticker, clock, busy=busy)
        assert ticker.until(busy=busy) - began <= 2.0 * IDLE_S + 1e-9


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
        for sent, ready in ((skin, Ready(device=True)), (peer, Ready(device=True, door=True))):
            sent.send(b"x")
            assert wait([device], door, time.monotonic() + SOON_S) == ready
        assert wait([None], door, time.monotonic() + SOON_S) == Ready(door=True)
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
