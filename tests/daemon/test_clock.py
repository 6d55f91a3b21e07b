"""The wall clock: a step is seen once, and what is slewed is followed in silence."""

import pytest

from taxeld.service.clock import WallClock

HOUR_S = 3600.0


class Clocks:
    def __init__(self) -> None:
        self.wall, self.monotonic, self.each = 1e9, 50.0, 0.0

    def pass_s(self, seconds: float) -> None:
        self.wall += seconds
        self.monotonic += seconds

    def read_monotonic(self) -> float:
        self.pass_s(self.each)
        return self.monotonic


@pytest.mark.parametrize("by", [HOUR_S, -HOUR_S, 0.3, -0.3])
def test_a_step_of_the_clock_is_seen_once(by: float) -> None:
    clocks = Clocks()
    clock = WallClock(lambda: clocks.wall, clocks.read_monotonic)
    clocks.pass_s(0.01)
    assert clock.read() == (clocks.wall, 0.0)
    clocks.pass_s(0.01)
    clocks.wall += by
    now, seen = clock.read()
    assert now == clocks.wall
    assert seen == pytest.approx(by, abs=1e-5)
    clocks.pass_s(30.0)  # a tick that took long is no step
    assert clock.read()[1] == 0.0


def test_a_clock_that_is_slewed_is_followed_in_silence() -> None:
    clocks = Clocks()
    clock = WallClock(lambda: clocks.wall, clocks.read_monotonic)
    for _ in range(10_000):
        clocks.pass_s(0.01)
        clocks.wall += 0.01 * 500e-6
        assert clock.read()[1] == 0.0


def test_a_reading_during_which_the_process_was_suspended_is_ignored() -> None:
    clocks = Clocks()
    clock = WallClock(lambda: clocks.wall, clocks.read_monotonic)
    clocks.each = 1.0  # passes before each reading of the monotonic clock
    assert clock.read()[1] == 0.0
    clocks.each = 0.0
    clocks.wall += HOUR_S
    assert clock.read()[1] == pytest.approx(HOUR_S, abs=1e-5)
