"""A calibration: held presses, a skin at rest, and the fit; what cannot be known is refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld_hil.calibration import presses
from taxeld_hil.calibration.calibrate import Placed, best_fit
from taxeld_hil.calibration.fit import FitResult
from taxeld_hil.calibration.observer import STILL_SCANS, AtRest, at_rest
from taxeld_hil.calibration.presses import LEAST_SCANS, MOST_SCANS, Presses
from tests.hil.rig import MODEL, PLACED, SKIN, PressedSkin

GIVEN = Placed(PLACED, given=True)
KNOWN_GAIN_SD = 0.06


def fitted(skin: PressedSkin, known: Placed = GIVEN) -> FitResult:
    noise = np.full(len(SKIN), skin.noise)
    return best_fit(MODEL, skin.presses(), noise, known)[0]


def gain_off(fit: FitResult, skin: PressedSkin) -> Floats:
    """(M,) relative, of what each taxel reads at full depth."""
    counts = np.exp(fit.value.log_full + fit.value.log_gain)
    return np.abs(counts / (skin.full_scale * skin.gain) - 1.0)


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 10_000))
def test_what_was_put_in_comes_out_within_the_stated_uncertainty(seed: int) -> None:
    skin = PressedSkin.drawn(MODEL, seed)
    fit = fitted(skin)
    off = fit.value.mount - skin.mount
    assert np.hypot(*off[:2]) < 3e-4
    assert abs(off[2]) < np.radians(0.3)
    assert (np.abs(off) < 4.0 * fit.sd.mount).all()
    gains = gain_off(fit, skin)
    known = fit.sd.log_gain < KNOWN_GAIN_SD
    assert known.sum() >= 20
    assert np.median(gains[known]) < 0.03
    assert np.mean(gains < 2.0 * fit.sd.log_gain) > 0.85


@pytest.mark.check
@pytest.mark.parametrize("seed", [5])
def test_an_object_that_stands_some_millimetres_elsewhere_is_found_along(seed: int) -> None:
    skin = PressedSkin.drawn(MODEL, seed)
    near = se2.compose(PLACED, np.array([0.003, -0.003, 0.04]))
    fit = fitted(skin, Placed(near, given=False))
    off = fit.value.mount - skin.mount
    assert np.hypot(*off[:2]) < 5e-4
    assert abs(off[2]) < np.radians(0.5)
    assert np.hypot(*(fit.value.object - PLACED)[:2]) < 1e-3


def test_a_module_that_reads_a_neighbours_press_along_biases_no_gain_by_much() -> None:
    skin = PressedSkin.drawn(MODEL, 3)
    presses = skin.presses()
    module = SKIN.uid >> 4
    coupled = presses.counts.copy()
    for m in np.unique(module):
        own = module == m
        strongest = presses.counts[:, own].max(axis=1, keepdims=True)
        coupled[:, own] += np.where(presses.counts[:, own] < strongest, 0.03 * strongest, 0.0)
    noise = np.full(len(SKIN), skin.noise)
    told = replace(presses, counts=coupled)
    fit, *_ = best_fit(MODEL, told, noise, GIVEN)
    known = fit.sd.log_gain < KNOWN_GAIN_SD
    assert np.median(gain_off(fit, skin)[known]) < 0.03


@pytest.mark.check
def test_noise_that_is_written_is_what_readings_keep() -> None:
    skin = PressedSkin.drawn(MODEL, 5)
    presses = skin.presses()
    noise = np.full(len(SKIN), skin.noise)
    _, quiet = best_fit(MODEL, presses, noise, GIVEN)
    rough = 0.045 * skin.full_scale * np.random.default_rng(2).standard_normal(presses.counts.shape)
    pressed = presses.counts > 0.1 * skin.full_scale
    worse = replace(presses, counts=presses.counts + np.where(pressed, rough, 0.0))
    _, loud = best_fit(MODEL, worse, noise, GIVEN)
    assert loud.sigma > 1.2 * quiet.sigma


def refused(skin: PressedSkin, known: Placed = GIVEN) -> str:
    with pytest.raises(SetupError) as error:
        fitted(skin, known)
    return str(error.value)


def test_too_few_presses_are_refused() -> None:
    skin = PressedSkin.drawn(MODEL, 0)
    message = refused(replace(skin, sensor=skin.sensor[:7]))
    assert message.startswith("calibrate: 7 presses were held still, and it takes 12;")


def test_presses_of_one_side_of_the_skin_are_refused() -> None:
    skin = PressedSkin.drawn(MODEL, 0)
    # the object pressed at one place, by the same side each time
    one = np.repeat(skin.sensor[:1], 15, axis=0)
    message = refused(replace(skin, sensor=one))
    # on the border of two sides they are on both
    assert re.match("calibrate: the presses are on [12] of the skin's sides", message)
    assert "turn the sensor" in message


def test_a_mount_is_refused_that_cannot_be_told_from_the_objects_pose() -> None:
    skin = PressedSkin.drawn(MODEL, 1, presses=24)
    yaw = 0.3  # of the sensor, at all presses: it goes round the object and never turns
    path = []
    for pose in skin.sensor:
        about = PLACED[:2] - pose[:2]
        path.append([*pose[:2], yaw + 0.0 * about[0]])
    fixed = replace(skin, sensor=np.array(path))
    near = se2.compose(PLACED, np.array([0.001, 0.001, 0.01]))
    message = refused(fixed, Placed(near, given=False))
    assert message.startswith("calibrate: the mount cannot be told (sd ")
    assert "turn the sensor between presses (its yaw differs by 0° now), or give" in message


@pytest.mark.check
def test_an_object_that_is_not_where_it_is_said_to_be_is_refused() -> None:
    skin = PressedSkin.drawn(MODEL, 2)
    wrong = Placed(se2.compose(PLACED, np.array([0.03, 0.02, 0.5])), given=True)
    message = refused(skin, wrong)
    assert "explains the presses" in message or "cannot be told" in message


@pytest.mark.check
def test_presses_of_swapped_modules_or_of_an_object_that_moves_are_refused() -> None:
    skin = PressedSkin.drawn(MODEL, 6)
    presses = skin.presses()
    module = SKIN.uid >> 4
    second, third = (np.flatnonzero(module == each) for each in np.unique(module)[1:3])
    swapped = presses.counts.copy()
    swapped[:, second], swapped[:, third] = presses.counts[:, third], presses.counts[:, second]
    moved = presses.sensor.copy()
    moved[10:] = se2.compose(np.array([0.004, 0.002, 0.05]), moved[10:])
    noise = np.full(len(SKIN), skin.noise)
    for wrong in (replace(presses, counts=swapped), replace(presses, sensor=moved)):
        with pytest.raises(SetupError, match="no mount within 6 mm and 8° explains the presses"):
            best_fit(MODEL, wrong, noise, GIVEN)


TAXELS, SCAN_S = 6, 0.05
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


def rest_of(counts: Floats) -> AtRest:
    return at_rest(SCAN_S * np.arange(len(counts)), np.round(counts))


def test_noise_and_drift_are_measured_of_a_skin_that_is_left_alone() -> None:
    rng, scans = np.random.default_rng(0), 1200
    minutes = np.arange(scans)[:, None] * SCAN_S / 60.0
    noise = np.array([0.6, 2.0, 20.0, 60.0])
    counts = 10_000.0 + 12.0 * minutes + noise * rng.standard_normal((scans, 4))
    facts = rest_of(counts)
    assert facts.noise == pytest.approx(noise, rel=0.2)
    slope_sd = noise / (np.sqrt(scans / 12.0))  # of a minute's regression
    assert (np.abs(facts.drift - 12.0) < 4.0 * slope_sd).all()
    assert not facts.frozen.any()


def test_a_frozen_taxel_is_told_from_a_quiet_one_below_a_count_of_noise() -> None:
    rng = np.random.default_rng(1)
    counts = 10_000.0 + 0.35 * rng.standard_normal((STILL_SCANS + 800, 2))
    counts[:, 1] = 9_876.0
    facts = rest_of(counts)
    assert facts.frozen.tolist() == [False, True]


def test_a_taxel_that_does_not_answer_is_not_called_frozen() -> None:
    facts = rest_of(np.zeros((STILL_SCANS + 10, 1)))
    assert not facts.frozen.any()
