"""Transforms of ROS 2: where the skin is, from all frames between it and the world."""

import math

import numpy as np
import pytest

from taxeld_ros2.transforms import BACK_S, FRAMES_MAX, KEPT, Rigid, Transforms

NOWHERE = Rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def turned(x: float, y: float, yaw: float) -> Rigid:
    return Rigid((x, y, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


def any_rigid(rng: np.random.Generator) -> Rigid:
    q = rng.normal(size=4)
    found = Rigid.of(tuple(rng.normal(size=3)), tuple(q / np.linalg.norm(q)))
    assert found is not None
    return found


def matrix(rigid: Rigid) -> np.ndarray:
    """Homogeneous, by the textbook."""
    x, y, z, w = rigid.turn
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = turn, rigid.at
    return made


def test_places_are_put_together_and_turned_round_as_matrices_are() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = any_rigid(rng), any_rigid(rng)
        assert np.allclose(matrix(a.then(b)), matrix(a) @ matrix(b))
        assert np.allclose(matrix(a.inverse()), np.linalg.inv(matrix(a)))


def test_yaw_and_tilt_are_those_of_the_axes() -> None:
    assert turned(0, 0, 2.5).yaw == pytest.approx(2.5)
    assert turned(0, 0, 2.5).tilt == pytest.approx(0.0)
    tipped = Rigid((0.0, 0.0, 0.0), (math.sin(0.15), 0.0, 0.0, math.cos(0.15)))
    assert tipped.tilt == pytest.approx(0.3)
    rng = np.random.default_rng(1)
    for _ in range(20):
        rigid = any_rigid(rng)
        assert rigid.tilt == pytest.approx(math.acos(matrix(rigid)[2, 2]))
        x_axis = matrix(rigid)[:3, 0]
        assert rigid.yaw == pytest.approx(math.atan2(x_axis[1], x_axis[0]))


@pytest.mark.parametrize(
    ("at", "turn"),
    [
        ((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        ((0.0, math.inf, 0.0), (0.0, 0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, math.nan)),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0)),
    ],
)
def test_numbers_that_are_no_place_are_refused(
    at: tuple[float, float, float], turn: tuple[float, float, float, float]
) -> None:
    assert Rigid.of(at, turn) is None
    tree = Transforms("world", "skin")
    tree.take(1.0, "world", "skin", Rigid.of(at, turn), False)
    assert tree.news() is None
    assert tree.refused == 1


def test_a_chain_of_moving_and_standing_frames_is_followed() -> None:
    tree = Transforms("world", "/skin")
    tree.take(0.0, "link", "skin", turned(0.1, 0.0, 0.0), True)
    tree.take(5.0, "base", "link", turned(0.0, 0.0, math.pi / 2), False)
    tree.take(0.0, "/world", "base", turned(1.0, 2.0, 0.0), True)
    told = tree.news()
    assert told is not None
    t, rigid = told
    assert t == 5.0
    assert rigid.at == pytest.approx((1.0, 2.1, 0.0))
    assert rigid.yaw == pytest.approx(math.pi / 2)
    assert tree.fault() == ""


def test_frames_on_two_branches_are_found_from_where_they_part() -> None:
    """The world may hang on the robot's base, as with a camera that found it."""
    tree = Transforms("table", "skin")
    tree.take(1.0, "base", "skin", turned(1.0, 0.0, 0.0), False)
    tree.take(1.0, "base", "table", turned(0.0, 1.0, math.pi / 2), False)
    tree.take(1.0, "map", "base", turned(50.0, 60.0, 1.0), False)
    told = tree.news()
    assert told is not None
    assert told[1].at == pytest.approx((-1.0, -1.0, 0.0))
    assert told[1].yaw == pytest.approx(-math.pi / 2)


def test_what_is_above_both_frames_need_not_be_fresh() -> None:
    tree = Transforms("table", "skin")
    tree.take(1.0, "map", "base", NOWHERE, False)
    tree.take(9.0, "base", "table", NOWHERE, False)
    tree.take(9.0, "table", "skin", NOWHERE, False)
    assert tree.news() == (9.0, NOWHERE)


def test_frames_of_different_rates_are_joined_at_a_time_that_all_know() -> None:
    tree = Transforms("world", "skin")
    tree.take(10.0, "world", "link", turned(1.0, 0.0, 0.2), False)
    tree.take(11.0, "world", "link", turned(2.0, 0.0, 0.4), False)
    tree.take(10.5, "link", "skin", turned(0.0, 0.0, 0.0), False)
    told = tree.news()
    assert told is not None
    t, rigid = told
    assert t == 10.5
    assert rigid.at == pytest.approx((1.5, 0.0, 0.0))
    assert rigid.yaw == pytest.approx(0.3, abs=1e-4)
    assert tree.news() is None, "each time is told once"


def test_turns_half_a_turn_of_sign_apart_are_one_turn() -> None:
    """A quaternion and its negative are the same turn."""
    a, b = turned(0, 0, 1.0), turned(0, 0, 1.1)
    negative = Rigid(b.at, tuple(-q for q in b.turn))  # type: ignore[arg-type]
    assert a.towards(negative, 0.5).yaw == pytest.approx(1.05)


def test_a_clock_that_was_set_back_begins_anew_and_a_late_message_does_not() -> None:
    tree = Transforms("world", "skin")
    tree.take(100.0, "world", "skin", turned(1.0, 0.0, 0.0), False)
    assert tree.news() is not None
    tree.take(100.0 - BACK_S / 2, "world", "skin", turned(5.0, 0.0, 0.0), False)
    assert tree.news() is None
    tree.take(3.0, "world", "skin", turned(2.0, 0.0, 0.0), False)
    told = tree.news()
    assert told is not None
    assert (told[0], told[1].at) == (3.0, (2.0, 0.0, 0.0))


def test_what_is_kept_of_a_frame_is_bounded_and_older_times_are_not_guessed() -> None:
    tree = Transforms("world", "skin")
    tree.take(1.0, "link", "skin", NOWHERE, False)
    for k in range(2 * KEPT):
        tree.take(2.0 + k, "world", "link", NOWHERE, False)
    assert tree.news() is None
    edge = tree._edges["link"]
    assert len(edge._held) == KEPT


def test_frames_without_end_are_not_kept() -> None:
    tree = Transforms("world", "skin")
    tree.take(1.0, "world", "skin", NOWHERE, False)
    for k in range(FRAMES_MAX + 10):
        tree.take(1.0, "world", f"frame{k}", NOWHERE, False)
    assert len(tree._edges) == FRAMES_MAX
    assert tree.refused == 11
    tree.take(2.0, "world", "skin", NOWHERE, False)
    assert tree.news() == (2.0, NOWHERE)


def test_frames_that_go_round_end() -> None:
    tree = Transforms("world", "skin")
    for parent, child in (("a", "b"), ("b", "a"), ("a", "skin"), ("skin", "skin")):
        tree.take(1.0, parent, child, NOWHERE, False)
    assert tree.news() is None
    assert tree.refused == 1


def test_why_no_place_can_be_told_is_said_with_the_frames_name() -> None:
    tree = Transforms("world", "skin")
    assert tree.fault() == "no transform names the frame 'world'"
    tree.take(1.0, "world", "base", NOWHERE, False)
    assert tree.fault() == "no transform names the frame 'skin'"
    tree.take(1.0, "flange", "skin", NOWHERE, True)
    assert tree.fault() == "no transforms lead from the frame 'world' to 'skin'"
    tree.take(1.0, "world", "flange", NOWHERE, True)
    assert tree.fault() == "'skin' never moves in 'world': no robot moves the skin"
    assert tree.news() is None
