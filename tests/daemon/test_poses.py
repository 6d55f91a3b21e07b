"""The sensor's poses over time: which are taken, what is told of a moment between them, and that an
estimate from places that are badly known is less sure, never wrong."""

import itertools
import math
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.estimator.estimate import Status
from taxeld.model import se2
from taxeld.model.symmetry import add_m
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld.pipeline.poses import AGE_S, BACK_MAX, EXTRAPOLATE_S, PACED, Pace, PoseTrack
from taxeld.proposals.bundle import Bundle
from taxeld.service.inputs import PoseWatch
from taxeld.stream.link import PeerLine
from taxeld_protocol.decoder import Scan
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.skins import SKIN

from .test_pipeline import CAN, ROBOT, START_S, TRUTH, pipeline_of


def test_poses_are_interpolated_through_the_turn() -> None:
    track = PoseTrack()
    track.add(1.0, 0.0, 0.0, 3.1)
    track.add(1.1, 0.1, -0.2, -3.1)
    pose = track.at(1.05)
    assert np.allclose(pose[:2], [0.05, -0.1])
    assert np.isclose(abs(pose[2]), np.pi)


@pytest.mark.parametrize(("t", "known"), [(0.9, False), (1.0, True), (1.3, True), (1.31, False)])
def test_a_pose_too_old_or_too_young_is_none(t: float, known: bool) -> None:
    track = PoseTrack()
    track.add(1.0, 0.0, 0.0, 0.0)
    track.add(1.1, 0.0, 0.0, 0.0)
    assert (track.at(t) is not None) == known


def test_poses_back_in_time_or_not_finite_are_rejected() -> None:
    track = PoseTrack()
    track.add(1.0, 0.0, 0.0, 0.0)
    for row in ((1.0, 1, 1, 1), (0.5, 1, 1, 1), (2.0, np.nan, 0, 0), (np.nan, 0, 0, 0)):
        track.add(*row)
    assert track.rejected == 4
    assert track.latest_t == 1.0


def test_a_pose_that_jumped_is_not_mixed_with_its_neighbours_and_is_no_speed() -> None:
    """Between a right pose and a wrong one lie places that look right and are not."""
    track = PoseTrack()
    for t, x in ((1.00, 0.3), (1.01, 2.3), (1.02, 0.3)):
        track.add(t, x, 0.0, 0.0)
    placed = [track.at(t) for t in (1.004, 1.006, 1.014, 1.016)]
    assert [pose[0] for pose in placed if pose is not None] == [0.3, 2.3, 2.3, 0.3]
    assert track.sd_m(1.016, 0.0) == 0.0


def test_a_robot_whose_clock_is_set_back_is_followed() -> None:
    track = PoseTrack()
    for k in range(20):
        track.add(1e4 + 0.01 * k, 0.0, 0.0, 0.0)
    for k in range(BACK_MAX):
        assert track.at(500.0 + 0.01 * k) is None
        track.add(500.0 + 0.01 * k, 1.0, 0.0, 0.0)
    assert track.latest_t == pytest.approx(500.0 + 0.01 * (BACK_MAX - 1))
    assert track.rejected == BACK_MAX - 1


@pytest.mark.parametrize(
    ("stray_s", "now_s", "taken"),
    [(3600.0, 0.0, 20), (3600.0, math.inf, 12), (-100.0, math.inf, 20)],
    ids=["future", "future, and no clock", "past"],
)
def test_poses_between_others_of_another_time_do_not_silence_the_robot(
    stray_s: float, now_s: float, taken: int
) -> None:
    track = PoseTrack()
    for k in range(20):
        t = 500.0 + 0.01 * k
        track.add(t, 0.3, 0.0, 0.0, t + now_s)
        if k == 0 or now_s == 0.0 or stray_s < 0.0:
            track.add(t + stray_s, 1.0, 0.0, 0.0, t + now_s)
    assert track.taken == taken
    assert track.latest_t == pytest.approx(500.19)


@pytest.mark.parametrize("far", [(1e9, 0.0), (0.0, -1e9), (10.01, 0.0)])
def test_a_pose_that_the_robot_cannot_reach_is_not_taken(far: tuple[float, float]) -> None:
    track = PoseTrack()
    track.add(1.00, 10.0, -10.0, 0.0)
    track.add(1.01, *far, 0.0)
    assert track.latest_t == 1.0
    assert (track.taken, track.rejected) == (1, 1)


AGES = st.floats(0.0, AGE_S)


@given(AGES, AGES)
def test_at_rest_a_place_is_as_sure_as_the_robot(after_s: float, late_s: float) -> None:
    track = PoseTrack()
    for k in range(40):
        track.add(10.0 + 0.01 * k, 0.3, 0.0, 0.2)
    assert track.sd_m(10.39 + after_s, late_s) == 0.0


@given(st.floats(10.1, 10.3 + AGE_S), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0))
def test_in_motion_a_place_is_uncertain_by_the_way_to_the_nearest_pose(
    t: float, speed: float, turning: float
) -> None:
    """Before and after a pose, and beyond the last: a turn counts where the skin is."""
    track = PoseTrack(reach_m=0.04)
    times = [10.0 + 0.1 * k for k in range(4)]
    for each in times:
        track.add(each, speed * (each - 10.0), 0.0, turning * (each - 10.0))
    way = abs(speed) + 0.04 * abs(turning)
    assert track.sd_m(t, 0.0) == pytest.approx(way * min(abs(t - each) for each in times), abs=1e-6)


@given(st.floats(0.25, 0.35), st.floats(0.2, 0.4))
def test_a_robot_that_turns_back_between_two_poses_is_within_two_sd(back: float, t: float) -> None:
    def x(at: float) -> float:
        return 0.1 * (back - abs(at - back))

    track = PoseTrack()
    for k in range(7):
        track.add(0.1 * k, x(0.1 * k), 0.0, 0.0)
    assert abs(track.at(t)[0] - x(t)) <= 2.0 * track.sd_m(t, 0.0) + 1e-9


def test_a_scan_that_may_be_late_counts_the_motion_before_it() -> None:
    track = PoseTrack()
    for k in range(20):
        track.add(0.01 * k, 0.001 * min(k, 10), 0.0, 0.0)  # it stops at 0.1 s
    assert track.sd_m(0.16, 0.04) == 0.0
    assert track.sd_m(0.16, 0.08) == pytest.approx(0.1 * 0.08 / math.sqrt(3.0))


@given(st.lists(st.floats(0.0, 0.2), min_size=30, max_size=30))
def test_an_unstamped_scan_is_late_by_what_it_was_held_up(held_s: list[float]) -> None:
    """As long as one of the last was not, and up to a period; what waits is read in its order."""
    pace, read, last = Pace(0.05), 0.0, list[float]()
    for k, held in enumerate(held_s):
        sent = 0.05 * k
        read = max(read, sent + (0.0 if k % 4 == 0 else held))
        last = [*last, read - sent][-1 - PACED :]
        late = pace.late_s(1, 100.0 + read)
        assert late == pytest.approx(min(last[-1] - min(last), 0.05), abs=1e-9)


def test_the_pace_is_each_hubs_own_and_forgets_a_scan_that_was_lost() -> None:
    pace = Pace(0.05)
    lost = [pace.late_s(1, 0.05 * k) for k in range(20) if k != 10]
    assert lost == pytest.approx([0.0] * 10 + [0.05] * PACED + [0.0] * (9 - PACED))
    assert pace.late_s(2, 7.0) == 0.0
    stamped = Pace(math.inf)
    assert [stamped.late_s(1, t) for t in (0.0, 0.05, 3.0)] == [0.0, 0.0, 0.0]


RADIUS_M = SKIN.radius_m
SLCAN = 'kind = "can"\ninterface = "slcan"\nchannel = "/dev/ttyACM0"'
SERIAL = 'kind = "serial"\nchannel = "/dev/ttyUSB0"'
EVERY = 9  # of so many poses one arrives
FAST_M_S = 0.25
AFTER_S = 0.003  # of a pose, until a scan


def placed(box: Bundle, source: str = CAN) -> Pipeline:
    return pipeline_of(box, ROBOT, EXTRAPOLATE_S, source)


class Sweep:
    """A robot that goes past a box as fast as it travels, and always along y while it touches: what
    is placed too late is placed too low, each time."""

    def __init__(self, box: Bundle) -> None:
        (left, low), (right, high) = box.model.scene.outline.min(0), box.model.scene.outline.max(0)
        sides = (right + RADIUS_M - 0.003, left - RADIUS_M + 0.003)
        end, far = low - RADIUS_M + 0.004, 0.25
        way = [(far, -far)]
        for x in (0.0, 0.02):  # two bumps
            way += [(x, -far), (x, end), (x, -far)]
        for x, clear in zip(sides, (far, -far), strict=True):  # two slides
            way += [(x, low - 0.07), (x, high + 0.07), (clear, far), (clear, -far)]
        way += [(-0.02, -far), (-0.02, end), (-0.02, -far)]
        self.way = np.array(way)
        leg_s = np.hypot(*np.diff(self.way, axis=0).T) / FAST_M_S
        self.t = 1.5 + np.append(0.0, leg_s.cumsum())  # at rest until the skin is known
        self.model, self.skin = box.model, SimulatedSkin(SKIN, noise=5.0)

    def sensor(self, t: float) -> se2.Poses:
        """Its true pose (3,)."""
        x, y = (np.interp(t, self.t, column) for column in self.way.T)
        return se2.compose(TRUTH, np.array([x, y, 0.1]))

    def scan(self, t: float) -> Scan:
        seen = se2.compose(se2.inverse(self.sensor(t)), TRUTH)
        self.skin.press = 20_000.0 * self.model.activation(seen[None])[0]
        self.skin.t = START_S + t - 0.05
        return self.skin.scan()

    def felt_by(self, pipeline: Pipeline, first: int) -> Iterator[Outcome]:
        """What a daemon makes of each ninth of 100 poses a second, from number `first` on."""
        for k in range(round(100.0 * self.t[-1])):
            t = 0.01 * k
            if k % EVERY == first:
                pipeline.poses.add(START_S + t, *self.sensor(t).tolist())
            scans = [self.scan(t - 0.01 + AFTER_S)] if k % 5 == 4 else []
            yield from pipeline.advance(scans, START_S + t + 0.001)


def error_m(box: Bundle, outcome: Outcome) -> float:
    return add_m(box.model.scene, outcome.estimate.map, TRUTH)[1]


def sure(swept: list[list[Outcome]]) -> list[Outcome]:
    return [each for each in chain(*swept) if each.estimate.status is Status.CONVERGED]


def test_with_one_pose_of_nine_estimates_are_right_and_less_sure_for_it(
    box: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Than those of a filter that holds the places between poses for exact."""

    def swept() -> list[list[Outcome]]:
        return [list(Sweep(box).felt_by(placed(box), k)) for k in range(0, EVERY, 2)]

    thin = swept()
    assert all(error_m(box, each) < min(each.estimate.radius_m, 0.01) for each in sure(thin))
    assert all(error_m(box, outcomes[-1]) < 0.01 for outcomes in thin)
    monkeypatch.setattr(PoseTrack, "sd_m", lambda *_: 0.0)
    assert len(sure(thin)) < len(sure(swept()))


def why_not(box: Bundle, m_s: float, age_s: float, source: str = CAN, late_s: float = 0.0) -> Why:
    """Why the last scan is of no use to a skin that moves, whose poses are of `age_s` before each
    scan, where that scan was read late."""
    pipeline, skin = placed(box, source), SimulatedSkin(SKIN, noise=5.0)
    for k in range(24):
        skin.t += late_s * (k == 23)
        scan = skin.scan()
        pose_t = scan.t - age_s
        pipeline.poses.add(pose_t, m_s * (pose_t - 100.0), 0.0, 0.0)
        list(pipeline.advance([scan], scan.t))
        list(pipeline.advance([], scan.t + 0.03))
    why = pipeline.freshness.why(pipeline.estimate)
    assert (pipeline.inputs.scans_without_pose > 0) == (why is Why.NO_POSE)
    return why


@pytest.mark.parametrize(
    ("m_s", "age_s", "why"),
    [(0.0, 0.045, Why.UNTOUCHED), (0.2, 0.045, Why.UNTOUCHED), (0.25, 0.045, Why.NO_POSE)],
)
def test_a_pose_that_is_too_old_for_the_speed_is_none(
    box: Bundle, m_s: float, age_s: float, why: Why
) -> None:
    """A link may go as far meanwhile as an estimate may be off, `filter.within_m`."""
    assert why_not(box, m_s, age_s) is why


@pytest.mark.parametrize("source", [SLCAN, SERIAL])
def test_a_scan_without_a_stamp_is_placed_no_nearer_than_it_was_read_late(
    box: Bundle, source: str
) -> None:
    assert why_not(box, 0.5, 0.005, source) is Why.UNTOUCHED
    assert why_not(box, 0.0, 0.005, source, late_s=0.06) is Why.UNTOUCHED
    assert why_not(box, 0.5, 0.005, source, late_s=0.06) is Why.NO_POSE
    assert why_not(box, 0.5, 0.005, CAN, late_s=0.06) is Why.UNTOUCHED


NOW = 1_700_000_000.0
PERIOD_S = 0.05
ENDPOINT = "tcp://127.0.0.1:9874"
Told = Callable[[float], float]


def right(now: float) -> float:
    return now - 0.002


def look(watch: PoseWatch, now: float, **line: Any) -> None:
    is_heard = line.pop("is_heard", True)
    watch.look(now, PeerLine(**{"connected": True} | line), is_heard=is_heard)


def watched(told: Told, rate_hz: float = 100.0, late_s: float = 0.0) -> PoseWatch:
    """A watch, looked at once a second, over a robot that sends poses of the times `told` for
    eight seconds."""
    watch = PoseWatch(ENDPOINT, PERIOD_S)
    sent = 0
    for second in itertools.count(1):
        while sent < rate_hz * min(second, 8.0):
            now = NOW + sent / rate_hz
            watch.add(told(now), now)
            sent += 1
        look(watch, NOW + second)
        if second >= 8.0 + late_s:
            return watch
    raise AssertionError


@pytest.mark.parametrize(
    ("told", "rate_hz", "late_s", "fault"),
    [
        (right, 100.0, 0.0, ""),
        (right, 25.0, 0.0, ""),
        (lambda now: now - 4.2, 100.0, 0.0, "their times are not of this machine's clock"),
        (lambda now: 1e3 * now, 100.0, 0.0, "their times are not of this machine's clock"),
        (lambda now: now - NOW, 100.0, 0.0, "their times are not of this machine's clock"),
        (right, 2.0, 0.0, "fewer poses than scans come: publish 100 a second"),
        (right, 100.0, 5.0, f"connected to {ENDPOINT}, and no pose comes: publish"),
    ],
)
def test_poses_tell_the_mistake(told: Told, rate_hz: float, late_s: float, fault: str) -> None:
    found = watched(told, rate_hz, late_s).fault
    assert found.startswith(fault)
    assert bool(found) == bool(fault)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ({"connected": False}, f"nobody serves {ENDPOINT}: start the publisher; it binds"),
        ({"refused": True}, f"{ENDPOINT} refuses the daemon: both must use keys, or neither"),
        ({}, f"connected to {ENDPOINT}, and no pose comes: publish /robot/sensor_pose"),
    ],
)
def test_without_poses_the_connection_tells_the_mistake_also_while_the_door_is_not_heard(
    line: dict[str, Any], fault: str
) -> None:
    watch = PoseWatch(ENDPOINT, PERIOD_S)
    for second in range(3):
        look(watch, NOW + second, **line)
    assert watch.fault.startswith(fault)
    look(watch, NOW + 3.0, is_heard=False)
    assert watch.fault.startswith(fault)


@pytest.mark.parametrize("is_far", [True, False])
def test_messages_that_are_no_poses_or_in_millimetres_are_a_fault_while_they_come(
    is_far: bool,
) -> None:
    watch, faults = watched(right), list[str]()
    for k, n in enumerate((3, 6, 9, 9)):
        watch.add(NOW, NOW, is_far=is_far and k < 3)
        malformed = 0 if is_far else n
        faults.append(heard(watch, NOW + 9.0 + k, malformed=malformed, reason="t is no number"))
    said = "messages come and are no poses: t is no number"
    if is_far:
        said = "x or y is beyond 10 m: send metres, not millimetres"
    assert faults == ["", "", said, ""]


def heard(watch: PoseWatch, now: float, **line: Any) -> str:
    """The fault after another second of right poses."""
    for k in range(100):
        watch.add(right(now - 0.01 * k), now - 0.01 * k)
    look(watch, now, **line)
    return watch.fault


def test_a_machine_that_is_late_now_and_then_is_no_fault_of_the_robots_clock() -> None:
    watch = PoseWatch(ENDPOINT, PERIOD_S)
    for second in range(40):
        late_s = 0.002 if second % 5 == 4 else 0.4
        watch.add(NOW + second - late_s, NOW + second)
        look(watch, NOW + second)
        assert "times" not in watch.fault


def test_a_clock_that_was_set_is_no_fault_of_the_robot() -> None:
    watch = watched(right)
    watch.clock_stepped()
    assert [heard(watch, NOW + 3600.0 + second) for second in range(9, 12)] == [""] * 3
