"""Deadlines, on a fake clock."""

from itertools import pairwise

import pytest

from taxeld.service.ticker import REST_S, Ticker


class FakeClock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds


def test_ticks_keep_the_rate_without_drift() -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock, clock.sleep)
    times = []
    for k in range(1000):
        times.append(ticker.wait())
        clock.now += 0.003 + 0.001 * (k % 5)  # work of varying length
    assert times == pytest.approx([0.01 * (k + 1) for k in range(1000)])
    assert ticker.missed == 0


@pytest.mark.parametrize(
    ("stall_s", "missed"), [(0.0099, 0), (0.0101, 1), (0.025, 2), (3.001, 300)]
)
def test_missed_ticks_are_skipped_and_counted(stall_s: float, missed: int) -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock, clock.sleep)
    ticker.wait()
    clock.now += stall_s
    after = [ticker.wait() for _ in range(3)]
    assert ticker.missed == missed
    assert after[1] - after[0] == pytest.approx(0.01)
    assert (after[0] / 0.01) == pytest.approx(round(after[0] / 0.01))


def test_what_is_left_of_a_tick_is_counted_down_below_nothing() -> None:
    clock = FakeClock()
    ticker = Ticker(100.0, clock, clock.sleep)
    ticker.wait()
    assert ticker.left_s() == pytest.approx(0.01)
    clock.now += 0.015
    assert ticker.left_s() == pytest.approx(-0.005)


def test_in_slow_ticks_others_have_their_turn_and_the_rate_is_kept() -> None:
    clock, turns = FakeClock(), list[float]()
    ticker = Ticker(2.0, clock, clock.sleep, turns.append)
    assert [ticker.wait() for _ in range(4)] == pytest.approx([0.5, 1.0, 1.5, 2.0])
    assert max(b - a for a, b in pairwise([0.0, *turns, 2.0])) <= 3.0 * REST_S + 1e-9
    assert ticker.missed == 0


def test_in_fast_ticks_nobody_has() -> None:
    clock, turns = FakeClock(), list[float]()
    ticker = Ticker(100.0, clock, clock.sleep, turns.append)
    for _ in range(10):
        ticker.wait()
    assert turns == []
