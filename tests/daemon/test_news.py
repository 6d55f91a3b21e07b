"""Which scans count."""

import numpy as np

from taxeld.estimator.news import News
from taxeld.model.observation import Observation

LIVE = np.ones(4, dtype=bool)


def feel(strongest: float, x: float = 0.0) -> Observation:
    z = np.array([strongest, 0.0, 0.0, 0.0])
    return Observation(np.array([x, 0.0, 0.0]), z, LIVE)


def told(readings: list[float], x: list[float] | None = None) -> list[list[float]]:
    """The strongest activation of what each scan has counted, at 20 Hz."""
    news, where = News(0.04), x or [0.0] * len(readings)
    scans = [news.on_scan(0.05 * k, feel(r, where[k])) for k, r in enumerate(readings)]
    return [[] if felt is None else [float(felt.z.max())] for felt in scans]


def test_a_press_counts_once_when_it_stops_deepening() -> None:
    assert told([0.0, 0.2, 0.4, 0.6, 0.61, 0.6, 0.6]) == [[0.0], [], [], [], [0.61], [], []]


def test_a_tap_that_ends_while_deepening_counts_by_its_strongest_scan() -> None:
    assert told([0.0, 0.2, 0.5, 0.0, 0.0]) == [[0.0], [], [], [0.5], []]


def test_a_press_that_eases_counts_as_it_is_held() -> None:
    assert told([0.3, 0.6, 0.5, 0.5]) == [[], [], [0.5], []]


def test_a_slide_counts_every_few_millimetres() -> None:
    x = [0.0, 0.0, 0.002, 0.004, 0.006, 0.008, 0.012]
    assert [len(each) for each in told([0.5] * 7, x)] == [0, 1, 0, 0, 1, 0, 1]


def test_a_taxel_that_changes_much_counts() -> None:
    assert [len(each) for each in told([0.3, 0.3, 0.6, 0.9, 0.9])] == [0, 1, 0, 0, 1]


def test_a_release_tells_nothing_new() -> None:
    assert [len(each) for each in told([0.9, 0.9, 0.5, 0.3, 0.1])] == [0, 1, 0, 0, 0]


def test_silence_counts_as_the_sensor_moves_and_not_while_it_stands() -> None:
    x = [0.0, 0.0, 0.003, 0.006, 0.006, 0.02]
    assert [len(each) for each in told([0.0] * 6, x)] == [1, 0, 0, 1, 0, 1]


def test_a_flicker_does_not_begin_a_contact() -> None:
    news = News(0.04)
    for k, strongest in enumerate([0.5, 0.5, 0.0, 0.5, 0.5]):
        news.on_scan(0.05 * k, feel(strongest))
    assert news.contacts == 1
    news.on_scan(1.0, feel(0.0))
    assert not news.contact
    news.on_scan(1.1, feel(0.5))
    assert news.contacts == 2
