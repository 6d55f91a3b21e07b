"""Taxels that tell of themselves alone."""

import numpy as np

from taxeld.estimator.intake import Stuck


def run(readings: list[list[float]], moved_m: float) -> list[list[int]]:
    """Which taxels are stuck after each scan."""
    subject = Stuck(len(readings[0]))
    return [np.flatnonzero(subject.on_scan(np.array(z), moved_m)).tolist() for z in readings]


def test_a_taxel_that_reads_the_same_on_a_long_way_is_stuck() -> None:
    assert run([[1.0, 0.0]] * 6, 0.03) == [[], [], [], [], [0], [0]]


def test_one_that_changes_is_stuck_no_more() -> None:
    assert run([[0.5]] * 6 + [[0.52], [0.52]], 0.03)[-3:] == [[0], [], []]


def test_a_held_touch_is_not_stuck() -> None:
    """The skin stands still."""
    assert not any(run([[0.8, 0.4]] * 10_000, 0.0))


def test_a_press_after_silence_begins_its_way_anew() -> None:
    subject, z = Stuck(1), np.array([0.5])
    for _ in range(3):
        assert not subject.on_scan(z, 0.03).any()
    subject.released()
    assert [bool(subject.on_scan(z, 0.03)[0]) for _ in range(6)] == [False] * 4 + [True] * 2


def test_silence_is_not_stuck() -> None:
    assert not any(run([[0.0, 0.0]] * 20, 0.1))


def test_a_press_that_varies_on_its_way_is_not_stuck() -> None:
    rng = np.random.default_rng(0)
    readings = np.clip(0.5 + 0.02 * rng.standard_normal((200, 4)), 0.0, 1.0)
    assert not any(run(readings.tolist(), 0.005))
