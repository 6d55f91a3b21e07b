"""The pass comes with a scan's last frame: on a line and a clock that are made up."""

import bisect
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import mean, median

import pytest

from taxeld.service.gathering import LEAST_S, REST_S, Gathering
from taxeld.service.inputs import Ready

PERIOD_S = 0.05
HEAR_S, PASS_S = 0.00005, 0.0003  # what it takes to hear the device, and to look at it
FRAME_S = 0.00011  # on a bus of 1 Mbit/s


@dataclass
class Line:
    """Frames arrive at these times; a wait ends so much later than it should."""

    arrivals: list[float]
    late: Callable[[], float] = lambda: 0.0
    now_s: float = 0.0
    heard: int = 0
    disturbed_s: float | None = None  # when a peer comes

    def clock(self) -> float:
        return self.now_s

    def hear(self) -> int:
        """All that nobody has taken."""
        self.now_s += HEAR_S
        self.heard = bisect.bisect_right(self.arrivals, self.now_s)
        return self.heard

    def rest(self, until_s: float) -> Ready:
        if self.disturbed_s is not None and self.disturbed_s <= until_s:
            self.now_s, self.disturbed_s = max(self.now_s, self.disturbed_s), None
            return Ready(robot=True)
        self.now_s = max(self.now_s, until_s) + self.late()
        return Ready()

    def wait(self, until_s: float) -> Ready:
        come = self.arrivals[self.heard] if self.heard < len(self.arrivals) else float("inf")
        if come > until_s:
            return self.rest(until_s)
        self.now_s = max(self.now_s, come) + self.late()
        return Ready(device=True)


@dataclass
class Followed:
    """What became of scans."""

    delays_s: list[float] = field(default_factory=list)  # from each one's last frame to its pass
    in_vain: int = 0  # passes
    hearings: int = 0


def follow(gathering: Gathering, line: Line, scans: list[list[float]]) -> Followed:
    """As the loop does: wait, gather, look. Each scan is whole with its last frame."""
    found = Followed()

    def hear() -> int:
        found.hearings += 1
        return line.hear()

    for frames in scans:
        line.arrivals, line.heard = frames, 0
        while True:
            assert line.wait(frames[-1] + PERIOD_S).device
            line.now_s = max(line.now_s, frames[0])
            taken = len(frames) - len(line.arrivals)
            assert gathering.gather(line, hear, frames[-1] + PERIOD_S).device
            began_s = line.now_s
            line.now_s += PASS_S
            is_whole = line.heard == len(line.arrivals)
            rest_s = gathering.looked(int(is_whole))
            if is_whole:
                found.delays_s.append(began_s - frames[-1])
                break
            line.arrivals, line.heard = line.arrivals[line.heard :], 0
            found.in_vain += 1
            line.rest(line.now_s + rest_s)
            assert found.in_vain < 50 * len(scans), f"{taken} of {len(frames)}"
    return found


def scans_of(frames: int, each_s: float, count: int = 200, at_a_time: int = 1) -> list[list[float]]:
    """Frames that arrive one after the other, or so many `at_a_time`."""
    ends = [min((k // at_a_time + 1) * at_a_time, frames) * each_s for k in range(frames)]
    return [[PERIOD_S * (n + 1) + end for end in ends] for n in range(count)]


def settled(
    scans: list[list[float]], late: Callable[[], float] = lambda: 0.0
) -> tuple[Followed, int]:
    line = Line([], late)
    gathering = Gathering(line.clock)
    follow(gathering, line, scans[:100])
    return follow(gathering, line, scans[100:]), len(scans) - 100


@pytest.mark.parametrize("frames", [1, 5, 23, 180])
@pytest.mark.parametrize("at_a_time", [1, 8])
def test_the_pass_comes_with_the_last_frame_of_a_scan(frames: int, at_a_time: int) -> None:
    found, scans = settled(scans_of(frames, FRAME_S, at_a_time=at_a_time))
    took_s = frames * FRAME_S
    assert median(found.delays_s) <= 3.0 * HEAR_S + 0.02 * took_s
    assert max(found.delays_s) <= LEAST_S + 2.0 * HEAR_S + 0.08 * min(took_s, REST_S[1])
    assert found.in_vain <= 0.05 * scans
    assert found.hearings <= (4 + took_s / REST_S[1]) * scans


def test_a_scan_that_comes_in_one_piece_is_not_waited_for() -> None:
    """As from an adapter that hands it over so."""
    found, _ = settled(scans_of(23, FRAME_S, at_a_time=23))
    assert max(found.delays_s) <= HEAR_S + 1e-9
    assert found.in_vain == 0


def test_a_machine_that_is_late_now_and_then_does_not_make_the_other_scans_late() -> None:
    rng = random.Random(0)
    found, scans = settled(
        scans_of(23, FRAME_S, 600), lambda: rng.random() * 0.008 if rng.random() < 0.1 else 0.0
    )
    assert median(found.delays_s) <= 0.0005
    assert mean(found.delays_s) <= 0.002
    assert found.in_vain <= 0.2 * scans


def test_scans_that_become_faster_or_longer_are_followed() -> None:
    line = Line([])
    gathering = Gathering(line.clock)
    follow(gathering, line, scans_of(23, 4.0 * FRAME_S))
    line.now_s = 0.0
    assert median(follow(gathering, line, scans_of(23, FRAME_S)).delays_s[60:]) <= 0.0003
    line.now_s = 0.0
    assert median(follow(gathering, line, scans_of(60, FRAME_S)).delays_s[60:]) <= 0.0005


def test_a_scan_of_which_frames_are_lost_is_looked_at_all_the_same() -> None:
    line = Line([])
    gathering = Gathering(line.clock)
    scans = scans_of(23, FRAME_S)
    follow(gathering, line, scans[:100])
    line.arrivals, line.heard = scans[100][:15], 0
    assert line.wait(scans[100][-1] + PERIOD_S).device
    assert gathering.gather(line, line.hear, scans[100][0] + PERIOD_S).device
    assert line.now_s - scans[100][14] < REST_S[1]


def test_whoever_else_comes_is_not_kept_waiting() -> None:
    line = Line([])
    gathering = Gathering(line.clock)
    scans = scans_of(23, FRAME_S)
    follow(gathering, line, scans[:100])
    line.arrivals, line.heard = scans[100], 0
    line.wait(scans[100][-1])
    line.disturbed_s = scans[100][5]
    assert gathering.gather(line, line.hear, scans[100][-1]) == Ready(device=True, robot=True)
    assert line.now_s == scans[100][5]
    assert gathering.has_begun


def test_frames_that_are_no_scans_cost_a_look_now_and_then() -> None:
    """A bus that others flood."""
    now_s = 0.0
    gathering, rests = Gathering(lambda: now_s), []
    for _ in range(50):
        assert gathering.heard(10) == 0.0
        rests.append(gathering.looked(0))
    assert rests[10:] == [REST_S[1]] * 40
