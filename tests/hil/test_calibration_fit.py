"""A calibration: presses that are held still, and the fit; what cannot be known is refused."""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld_hil.calibration.calibrate import KNOWN_GAIN_SD, errors_of, fitted
from taxeld_hil.calibration.fit import FIRM, FitResult, likeliest
from taxeld_hil.calibration.presses import LEAST_SCANS, MOST_SCANS, Presses, PressFinder
from tests.hil.rig import MODEL, PLACED, SKIN, PressedSkin

from ..rig.examples import examples

MODULE = SKIN.uid >> 4
NOISE = np.full(len(SKIN), 20.0)
NEAR = se2.compose(PLACED, np.array([0.003, -0.003, 0.04]))


def gain_off(fit: FitResult, skin: PressedSkin) -> Floats:
    """(M,) relative, of what each taxel reads at full depth."""
    counts = np.exp(fit.value.log_full + fit.value.log_gain)
    return np.abs(counts / (skin.full_scale * skin.gain) - 1.0)


@examples(2)
@given(st.integers(0, 10_000))
def test_what_was_put_in_comes_out_within_the_stated_uncertainty(seed: int) -> None:
    skin = PressedSkin.drawn(MODEL, seed)
    fit = fitted(MODEL, skin.presses(), NOISE, PLACED, given=True)
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
def test_an_object_that_stands_some_millimetres_elsewhere_is_found_along() -> None:
    skin = PressedSkin.drawn(MODEL, 5)
    fit = fitted(MODEL, skin.presses(), NOISE, NEAR, given=False)
    off = fit.value.mount - skin.mount
    assert np.hypot(*off[:2]) < 5e-4
    assert abs(off[2]) < np.radians(0.5)
    assert np.hypot(*(fit.value.object - PLACED)[:2]) < 1e-3


def test_a_module_that_reads_a_neighbours_press_along_biases_no_gain_by_much() -> None:
    skin = PressedSkin.drawn(MODEL, 3)
    presses = skin.presses()
    coupled = presses.counts.copy()
    for m in np.unique(MODULE):
        own = m == MODULE
        strongest = presses.counts[:, own].max(axis=1, keepdims=True)
        coupled[:, own] += np.where(presses.counts[:, own] < strongest, 0.03 * strongest, 0.0)
    fit = fitted(MODEL, replace(presses, counts=coupled), NOISE, PLACED, given=True)
    known = fit.sd.log_gain < KNOWN_GAIN_SD
    assert np.median(gain_off(fit, skin)[known]) < 0.03


def test_taxels_that_answer_some_presses_alone_spoil_neither_mount_nor_gains() -> None:
    skin, rng = PressedSkin.drawn(MODEL, 4), np.random.default_rng(4)
    presses, answers = skin.presses(), rng.beta(0.6, 0.8, len(SKIN))
    silent = rng.random(presses.counts.shape) >= answers
    presses = replace(presses, counts=np.where(silent, 0.0, presses.counts))
    fit = fitted(MODEL, presses, NOISE, PLACED, given=True)
    assert np.hypot(*(fit.value.mount - skin.mount)[:2]) < 5e-4
    assert np.median(gain_off(fit, skin)[fit.sd.log_gain < KNOWN_GAIN_SD]) < 0.04
    firm = (fit.depth > FIRM).sum(axis=0) > 2
    assert np.corrcoef(fit.answers[firm], answers[firm])[0, 1] > 0.7


@pytest.mark.check
def test_noise_that_is_written_is_what_readings_keep() -> None:
    skin = PressedSkin.drawn(MODEL, 5)
    presses = skin.presses()
    rough = 0.045 * skin.full_scale * np.random.default_rng(2).standard_normal(presses.counts.shape)
    rough[presses.counts <= 0.1 * skin.full_scale] = 0.0
    quiet, loud = (
        errors_of(MODEL, each, NOISE, likeliest(MODEL, each, NOISE, PLACED, given=True)).sigma
        for each in (presses, replace(presses, counts=presses.counts + rough))
    )
    assert loud > 1.2 * quiet


def at_one_place(presses: Presses) -> Presses:
    """The object pressed at one place, by the same side each time."""
    return presses.only(np.zeros(15, dtype=int))


def swapped(presses: Presses) -> Presses:
    order = np.arange(len(SKIN))
    second, third = (np.flatnonzero(each == MODULE) for each in np.unique(MODULE)[1:3])
    order[second], order[third] = third, second
    return replace(presses, counts=presses.counts[:, order])


def moved(presses: Presses) -> Presses:
    """Between the presses the object has moved."""
    sensor = presses.sensor.copy()
    sensor[10:] = se2.compose(np.array([0.004, 0.002, 0.05]), sensor[10:])
    return replace(presses, sensor=sensor)


def unturned(_: Presses) -> Presses:
    """A sensor that goes round the object and never turns."""
    skin = PressedSkin.drawn(MODEL, 1, presses=24)
    skin.sensor[:, 2] = 0.3
    return skin.presses()


FEW = "calibrate: held still: 7; it takes at least 12; press the object more often"
ELSEWHERE = se2.compose(PLACED, np.array([0.03, 0.02, 0.5]))
ALMOST = se2.compose(PLACED, np.array([0.001, 0.001, 0.01]))
NO_MOUNT = "no mount within 6 mm and 8° explains the presses"
REFUSED = [
    (FEW, lambda presses: presses.only(np.arange(20) < 7), PLACED, True),
    # on the border of two sides the presses are on both
    (
        "calibrate: sides of the skin: [12]; it takes at least 4; turn the sensor",
        at_one_place,
        PLACED,
        True,
    ),
    (r"mount.*\(its yaw differs by 0° now\), or give the", unturned, ALMOST, False),
    pytest.param(f"{NO_MOUNT}|mount: ", copy.copy, ELSEWHERE, True, marks=pytest.mark.check),
    pytest.param(NO_MOUNT, swapped, PLACED, True, marks=pytest.mark.check),
    pytest.param(NO_MOUNT, moved, PLACED, True, marks=pytest.mark.check),
]


@pytest.mark.parametrize(("says", "change", "placed", "given"), REFUSED)
def test_presses_that_do_not_suffice_are_refused_with_the_cure(
    says: str, change: Callable[[Presses], Presses], placed: Poses, given: bool
) -> None:
    presses = change(PressedSkin.drawn(MODEL, 6).presses())
    with pytest.raises(SetupError, match=says):
        fitted(MODEL, presses, NOISE, placed, given=given)


TAXELS, THRESHOLD = 6, 300.0  # counts of a touch


def found(*moves: tuple[float, float, int]) -> tuple[list[float], int]:
    """What is found of (counts, step of the sensor [m], scans) in turn: counts of each press, all
    where the sensor stood, and how many presses were not held."""
    finder, x, stood = PressFinder(TAXELS, 0.04), 0.0, set()
    for counts, step_m, scans in moves:
        for _ in range(scans):
            x += step_m
            stood |= set() if step_m else {x}
            row = np.full(TAXELS, counts)
            live = np.ones(TAXELS, dtype=bool)
            finder.take(np.array([x, 0.0, 0.0]), row, live, row > THRESHOLD)
    presses, unheld = finder.found()
    assert (presses.counts == presses.counts[:, :1]).all()
    assert {*presses.sensor[:, 0].tolist()} <= stood
    return presses.counts[:, 0].tolist(), unheld


def press(counts: float, held: int = 10) -> list[tuple[float, float, int]]:
    """In by 4 mm, a hold, and out to where nothing is read."""
    way = [(share * counts, 0.001, 1) for share in (0.3, 0.6, 0.9, 1.0)]
    out = [(share * counts, -0.001, 1) for share in (0.6, 0.2, 0.0)]
    return [*way, (counts, 0.0, held), *out, (0.0, -0.001, 1)]


@pytest.mark.parametrize(
    ("moves", "counts", "unheld"),
    [
        ([*press(9000.0), *press(5000.0)], [9000.0, 5000.0], 0),
        ([*press(9000.0), (9000.0, 0.001, 8), (0.0, 0.001, 2)], [9000.0], 1),  # never still
        (press(9000.0, held=LEAST_SCANS - 2), [], 1),  # too short
        ([(3000.0, 0.001, 1), (3000.0, 0.0, 8), *press(9000.0)], [9000.0], 0),  # in stages
        # the foam keeps a residue over the threshold, which is no press and hides none
        ([*press(9000.0), (700.0, 0.0, 40), *press(8000.0), (500.0, 0.0, 40)], [9000, 8000], 0),
        # the foam gives way after a second
        ([(9e3, 0.001, 1), (9e3, 0.0, MOST_SCANS), (6e3, 0.0, 200), (0.0, 0.001, 3)], [9e3], 0),
    ],
)
def test_a_press_is_the_mean_of_its_deepest_hold(
    moves: list[tuple[float, float, int]], counts: list[float], unheld: int
) -> None:
    read, left_out = found(*moves)
    assert read == pytest.approx(counts)
    assert left_out == unheld
