"""The sensor's poses over time: which are taken, and what is told of a moment between them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.pipeline.poses import AGE_S, BACK_MAX, PACED, Pace, PoseTrack


def test_poses_are_interpolated_through_the_turn() -> None:
    track = PoseTrack()
    track.add(1.0, 0.0, 0.0, 3.1)
    track.add(1.1, 0.1, -0.2, -3.1)
    pose = track.at(1.05)
    assert pose is not None
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


def test_a_pose_that_jumped_is_not_mixed_with_its_neighbours() -> None:
    """Between a right pose and a wrong one lie places that look right and are not."""
    track = PoseTrack()
    for t, x in ((1.00, 0.3), (1.01, 2.3), (1.02, 0.3)):
        track.add(t, x, 0.0, 0.0)
    placed = [track.at(t) for t in (1.004, 1.006, 1.014, 1.016)]
    assert [pose[0] for pose in placed if pose is not None] == [0.3, 2.3, 2.3, 0.3]


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
    assert (track.taken, track.rejected, track.far) == (1, 1, 1)


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
    pose = track.at(t)
    assert pose is not None
    assert abs(pose[0] - x(t)) <= 2.0 * track.sd_m(t, 0.0) + 1e-9


def test_a_scan_that_may_be_late_counts_the_motion_before_it() -> None:
    track = PoseTrack()
    for k in range(20):
        track.add(0.01 * k, 0.001 * min(k, 10), 0.0, 0.0)  # it stops at 0.1 s
    assert track.sd_m(0.16, 0.04) == 0.0
    assert track.sd_m(0.16, 0.08) == pytest.approx(0.1 * 0.08 / math.sqrt(3.0))


def test_a_pose_that_jumped_is_no_speed() -> None:
    track = PoseTrack()
    for t, x in ((1.00, 0.3), (1.01, 2.3), (1.02, 0.3)):
        track.add(t, x, 0.0, 0.0)
    assert track.sd_m(1.016, 0.0) == 0.0


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
