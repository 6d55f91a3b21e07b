"""Transforms of ROS 2: where the skin is, from all frames between it and the world."""

import math

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld_ros2.transforms import BACK_S, KEPT, Transforms, between, matrix

ALWAYS = math.inf  # the time of a static transform


def place(x: float, y: float, yaw: float) -> Floats:
    made = matrix((x, y, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
    assert made is not None
    return made


NOWHERE = place(0.0, 0.0, 0.0)


def news(tree: Transforms) -> tuple[float, float, float, float]:
    """Time, x, y and yaw."""
    told = tree.news()
    assert told is not None
    t, at = told
    return t, float(at[0, 3]), float(at[1, 3]), math.atan2(at[1, 0], at[0, 0])


def test_a_quaternion_turns_as_the_textbook_says() -> None:
    """A third of a turn about (1, 1, 1) sends x to y, y to z and z to x."""
    made = matrix((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5))
    expected = [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(made, expected, atol=1e-12)


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
def test_numbers_that_are_no_place_are_left_out(
    at: tuple[float, ...], turn: tuple[float, ...]
) -> None:
    tree = Transforms("world", "skin")
    tree.take(1.0, "world", "skin", matrix(at, turn))
    assert tree.news() is None


def test_a_chain_of_moving_and_standing_frames_is_followed() -> None:
    tree = Transforms("world", "/skin")
    tree.take(ALWAYS, "link", "skin", place(0.1, 0.0, 0.0))
    tree.take(5.0, "base", "link", place(0.0, 0.0, math.pi / 2))
    tree.take(ALWAYS, "/world", "base", place(1.0, 2.0, 0.0))
    assert news(tree) == pytest.approx((5.0, 1.0, 2.1, math.pi / 2))


def test_frames_on_two_branches_are_found_from_where_they_part() -> None:
    """The world may hang on the robot's base, as with a camera that found it."""
    tree = Transforms("table", "skin")
    tree.take(1.0, "base", "skin", place(1.0, 0.0, 0.0))
    tree.take(1.0, "base", "table", place(0.0, 1.0, math.pi / 2))
    tree.take(0.5, "map", "base", place(50.0, 60.0, 1.0))  # above both, so it need not be fresh
    assert news(tree) == pytest.approx((1.0, -1.0, -1.0, -math.pi / 2))


def test_frames_of_different_rates_are_joined_at_a_time_that_all_know() -> None:
    tree = Transforms("world", "skin")
    tree.take(10.0, "world", "link", place(1.0, 0.0, 0.2))
    tree.take(11.0, "world", "link", place(2.0, 0.0, 0.4))
    tree.take(10.5, "link", "skin", NOWHERE)
    assert news(tree) == pytest.approx((10.5, 1.5, 0.0, 0.3))
    assert tree.news() is None, "each time is told once"


def test_between_two_places_a_rotation_stays_one() -> None:
    made = between(place(0, 0, 0.0), place(0, 0, 0.4), 0.25)[:3, :3]
    np.testing.assert_allclose(made @ made.T, np.eye(3), atol=1e-12)
    assert math.atan2(made[1, 0], made[0, 0]) == pytest.approx(0.1, abs=2e-3)


def test_a_clock_that_was_set_back_begins_anew_and_a_late_message_does_not() -> None:
    tree = Transforms("world", "skin")
    tree.take(100.0, "world", "skin", place(1.0, 0.0, 0.0))
    assert news(tree)[0] == 100.0
    tree.take(100.0 - BACK_S / 2, "world", "skin", place(5.0, 0.0, 0.0))
    assert tree.news() is None
    tree.take(3.0, "world", "skin", place(2.0, 0.0, 0.0))
    assert news(tree)[:2] == (3.0, 2.0)


def test_a_transform_that_holds_always_may_be_told_anew() -> None:
    tree = Transforms("world", "skin")
    tree.take(1.0, "world", "link", NOWHERE)
    tree.take(ALWAYS, "link", "skin", place(1.0, 0.0, 0.0))
    tree.take(ALWAYS, "link", "skin", place(2.0, 0.0, 0.0))
    assert news(tree)[1] == 2.0


@pytest.mark.parametrize(
    "links",
    [
        [(1.0, "world", "base"), (1.0, "flange", "skin")],
        [(ALWAYS, "world", "flange"), (ALWAYS, "flange", "skin")],
        [(1.0, "a", "b"), (1.0, "b", "a"), (1.0, "a", "skin"), (1.0, "skin", "skin")],
        [(1.0, "link", "skin"), *[(2.0 + k, "world", "link") for k in range(2 * KEPT)]],
    ],
    ids=["apart", "never moves", "a ring", "older than all that is kept"],
)
def test_frames_without_a_common_time_have_no_place(links: list[tuple[float, str, str]]) -> None:
    tree = Transforms("world", "skin")
    for t, parent, child in links:
        tree.take(t, parent, child, NOWHERE)
    assert tree.news() is None
