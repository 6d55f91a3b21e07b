"""The sensor's poses over time: which are taken, and what is told of a moment between them."""

import numpy as np
import pytest

from taxeld.pipeline.poses import BACK_MAX, PoseTrack


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


def test_a_pose_from_far_ahead_does_not_silence_the_robot() -> None:
    track = PoseTrack()
    track.add(1e9, 0.0, 0.0, 0.0)
    for k in range(BACK_MAX):
        track.add(500.0 + 0.01 * k, 1.0, 0.0, 0.0)
    assert track.at(500.1) is not None


def test_a_pose_that_is_stamped_in_the_future_costs_no_other_pose() -> None:
    track = PoseTrack()
    for k in range(20):
        now = 500.0 + 0.01 * k
        track.add(now, 0.3, 0.0, 0.0, now)
        track.add(now + 3600.0, 0.3, 0.0, 0.0, now)
    assert (track.taken, track.rejected) == (20, 20)
    assert track.at(500.19) is not None


@pytest.mark.parametrize("far", [(1e9, 0.0), (0.0, -1e9), (10.01, 0.0)])
def test_a_pose_that_the_robot_cannot_reach_is_not_taken(far: tuple[float, float]) -> None:
    track = PoseTrack()
    track.add(1.00, 10.0, -10.0, 0.0)
    track.add(1.01, *far, 0.0)
    assert track.latest_t == 1.0
    assert (track.taken, track.rejected, track.far) == (1, 1, 1)


def test_stray_poses_from_the_past_do_not_clear_the_track() -> None:
    track = PoseTrack()
    for k in range(1000):
        track.add(1000.0 + 0.01 * k, 0.0, 0.0, 0.0)
        track.add(900.0 + 0.01 * k, 1.0, 0.0, 0.0)
    assert track.rejected == 1000
