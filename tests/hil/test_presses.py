"""What a calibration is made of: presses that were held, and what a skin reads while it is idle."""

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld_hil.calibration import presses
from taxeld_hil.calibration.observer import STILL_SCANS, AtRest, at_rest
from taxeld_hil.calibration.presses import LEAST_SCANS, MOST_SCANS, Presses

TAXELS, PERIOD_S = 6, 0.05
LEAST = 300.0  # counts of a touch


class Hand:
    """Moves a sensor and presses, scan by scan."""

    def __init__(self) -> None:
        self.at = np.zeros(3)
        self.read: list[float] = []
        self.sensor: list[Poses] = []

    def scan(self, counts: float, step_m: float = 0.0, n: int = 1) -> None:
        for _ in range(n):
            self.at = self.at + np.array([step_m, 0.0, 0.0])
            self.sensor.append(self.at)
            self.read.append(counts)

    def found(self) -> tuple[Presses, int]:
        """The presses that were held, and how many were not."""
        counts = np.repeat(np.array(self.read)[:, None], TAXELS, axis=1)
        live = np.ones_like(counts, dtype=bool)
        return presses.find(np.array(self.sensor), counts, live, counts > LEAST, 0.04)

    def press(self, counts: float, held: int = 10) -> Poses:
        """In, a hold, and out to where nothing is read; → where it was held."""
        for share in (0.3, 0.6, 0.9):
            self.scan(share * counts, 0.001)
        self.scan(counts, 0.001)
        self.scan(counts, n=held)
        at = self.at.copy()
        for share in (0.6, 0.2, 0.0):
            self.scan(share * counts, -0.001)
        self.scan(0.0, -0.003, n=4)
        return at


def test_a_press_is_the_mean_of_its_hold_where_the_sensor_stood() -> None:
    hand = Hand()
    places = [hand.press(9000.0), hand.press(5000.0)]
    found, unheld = hand.found()
    assert found.sensor == pytest.approx(np.array(places))
    assert found.counts == pytest.approx(np.repeat([[9000.0], [5000.0]], TAXELS, axis=1))
    assert unheld == 0


def test_a_press_that_never_stands_still_is_counted_and_left_out() -> None:
    hand = Hand()
    hand.press(9000.0)
    for counts in (3000.0, 6000.0, 9000.0, 9000.0, 9000.0, 9000.0, 9000.0, 5000.0, 0.0, 0.0):
        hand.scan(counts, 0.001)
    found, unheld = hand.found()
    assert (len(found), unheld) == (1, 1)


def test_a_hold_that_is_too_short_is_none() -> None:
    hand = Hand()
    hand.press(9000.0, held=LEAST_SCANS - 2)
    found, unheld = hand.found()
    assert (len(found), unheld) == (0, 1)


def test_of_a_press_in_stages_the_deepest_is_used() -> None:
    hand = Hand()
    hand.scan(3000.0, 0.001)
    hand.scan(3000.0, n=8)
    hand.scan(6000.0, 0.001)
    hand.press(9000.0)
    assert hand.found()[0].counts == pytest.approx(np.full((1, TAXELS), 9000.0))


def test_what_foam_keeps_of_a_press_is_no_press_and_hides_none() -> None:
    hand = Hand()
    hand.press(9000.0)
    hand.scan(700.0, n=40)  # a residue over the threshold, the sensor at rest
    hand.press(8000.0)
    hand.scan(500.0, n=40)
    hand.scan(0.0, n=2)
    found, unheld = hand.found()
    assert found.counts[:, 0] == pytest.approx([9000.0, 8000.0])
    assert unheld == 0


def test_a_long_hold_is_read_in_its_first_second() -> None:
    hand = Hand()
    hand.scan(9000.0, 0.001)
    hand.scan(9000.0, n=MOST_SCANS)
    hand.scan(6000.0, n=200)  # the foam gives way
    hand.scan(0.0, -0.001, n=3)
    assert hand.found()[0].counts == pytest.approx(np.full((1, TAXELS), 9000.0))


def study(counts: Floats) -> AtRest:
    return at_rest(PERIOD_S * np.arange(len(counts)), np.round(counts))


def test_noise_and_drift_are_measured_of_a_skin_that_is_left_alone() -> None:
    rng, scans = np.random.default_rng(0), 1200
    minutes = np.arange(scans)[:, None] * PERIOD_S / 60.0
    noise = np.array([0.6, 2.0, 20.0, 60.0])
    counts = 10_000.0 + 12.0 * minutes + noise * rng.standard_normal((scans, 4))
    facts = study(counts)
    assert facts.noise == pytest.approx(noise, rel=0.2)
    slope_sd = noise / (np.sqrt(scans / 12.0))  # of a minute's regression
    assert (np.abs(facts.drift - 12.0) < 4.0 * slope_sd).all()
    assert not facts.frozen.any()


def test_a_frozen_taxel_is_told_from_a_quiet_one_below_a_count_of_noise() -> None:
    rng = np.random.default_rng(1)
    counts = 10_000.0 + 0.35 * rng.standard_normal((STILL_SCANS + 800, 2))
    counts[:, 1] = 9_876.0
    facts = study(counts)
    assert facts.frozen.tolist() == [False, True]


def test_a_taxel_that_does_not_answer_is_not_called_frozen() -> None:
    facts = study(np.zeros((STILL_SCANS + 10, 1)))
    assert not facts.frozen.any()
