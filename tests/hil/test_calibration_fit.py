"""A calibration: presses of a soft skin that are held still, and the fit; what cannot be known is
refused. The skin's readings are the simulated world's, and none of the fit's own model."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld_hil.calibration import calibrate
from taxeld_hil.calibration.calibrate import KNOWN_GAIN_SD, errors_of, fitted
from taxeld_hil.calibration.fit import FIRM, FitResult, likeliest
from taxeld_hil.calibration.presses import LEAST_SCANS, MOST_SCANS, PressFinder
from tests.hil.rig import MODEL, MOUNT, SKIN, Pressed, pressed

MODULE = SKIN.uid >> 4


def fit_of(found: Pressed, *, given: bool = True) -> FitResult:
    return fitted(MODEL, found.presses, found.noise, found.placed, given=given)


def gains_off(fit: FitResult, found: Pressed) -> Floats:
    """(M,) logarithm, of what each taxel reads at full depth."""
    true = found.world.skins[0].full_scale
    return np.asarray(np.abs(fit.value.log_full + fit.value.log_gain - np.log(true)))


@pytest.mark.parametrize(
    ("given", "beside"),
    [
        ({}, ()),
        pytest.param({"foam": "poor", "robot_m": 1e-4}, (), marks=pytest.mark.check),
        pytest.param({}, (0.003, -0.003, 0.04), marks=pytest.mark.check),
        pytest.param({"foam": "poor"}, (), marks=pytest.mark.check),
        pytest.param({"foam": "stiff"}, (), marks=pytest.mark.check),
    ],
)
def test_a_calibration_of_a_soft_skin_errs_by_no_more_than_it_states(
    given: dict[str, object], beside: tuple[float, ...]
) -> None:
    """Cover and foam are not in the fit's model, and the robot errs by about a millimetre. `beside`
    the true pose is the one that is told, which then is not certain."""
    found = [pressed(seed, **given) for seed in range(2)]
    if beside:
        found = [f._replace(placed=se2.compose(f.placed, np.array(beside))) for f in found]
    fits = [fit_of(each, given=not beside) for each in found]
    off = np.array([fit.value.mount - MOUNT for fit in fits])
    assert np.hypot(*off[:, :2].T).max() < 2e-3
    assert np.abs(off[:, 2]).max() < np.radians(1.5)
    stated = off / [fit.sd.mount for fit in fits]
    assert np.abs(stated).max() < 4.0
    assert np.sqrt(np.mean(stated**2)) < 1.7
    known = [fit.sd.log_gain < KNOWN_GAIN_SD for fit in fits]
    gains = [gains_off(fit, each) for fit, each in zip(fits, found, strict=True)]
    assert np.sum(known) > 5  # of 160: 15 to 48 over ten draws
    assert np.median(np.concatenate([g[k] for g, k in zip(gains, known, strict=True)])) < 0.07
    assert np.mean([g < 2.0 * fit.sd.log_gain for g, fit in zip(gains, fits, strict=True)]) > 0.85


def test_taxels_that_answer_some_presses_alone_spoil_no_mount_and_are_told() -> None:
    found = pressed(0, answers=0.6)
    fit = fit_of(found)
    assert np.hypot(*(fit.value.mount - MOUNT)[:2]) < 2e-3
    firm = (fit.depth > FIRM).sum(axis=0) > 2
    answers = found.world.skins[0].calibration(0.005).answers
    assert np.corrcoef(fit.answers[firm], answers[firm])[0, 1] > 0.6


@pytest.mark.check
def test_the_noise_of_a_calibration_is_what_readings_keep_and_not_what_the_robot_errs() -> None:
    exact, erring = pressed(0, robot_m=1e-4), pressed(0)
    counts, rng = exact.presses.counts.copy(), np.random.default_rng(2)
    felt = counts > 0.1 * counts.max()
    counts[felt] += 0.1 * 20_000.0 * rng.standard_normal(felt.sum())
    rough = exact._replace(presses=replace(exact.presses, counts=counts))
    quiet, loud, moved_about = (
        errors_of(MODEL, *each[1:3], likeliest(MODEL, *each[1:], given=True)).variance(np.ones(1))
        for each in (exact, rough, erring)
    )
    assert loud > 1.4 * quiet
    assert moved_about < 2.0 * quiet


def at_one_place(found: Pressed) -> Pressed:
    """The object pressed at one place, by the same side each time."""
    return found._replace(presses=found.presses.only(np.zeros(15, dtype=int)))


def swapped(found: Pressed) -> Pressed:
    order = np.arange(len(SKIN))
    second, third = (np.flatnonzero(each == MODULE) for each in np.unique(MODULE)[1:3])
    order[second], order[third] = third, second
    return found._replace(presses=replace(found.presses, counts=found.presses.counts[:, order]))


def moved(found: Pressed) -> Pressed:
    """Between the presses the object has moved."""
    sensor = found.presses.sensor.copy()
    sensor[10:] = se2.compose(np.array([0.008, 0.004, 0.1]), sensor[10:])
    return found._replace(presses=replace(found.presses, sensor=sensor))


def elsewhere(found: Pressed) -> Pressed:
    return found._replace(placed=se2.compose(found.placed, np.array([0.03, 0.02, 0.5])))


NO_MOUNT = "no mount within 6 mm and 8° explains the presses"
FEW = "calibrate: held still: 7; it takes at least 12; press the object more often"
# on the border of two sides the presses are on both
ONE_SIDE = "calibrate: sides of the skin: [12]; it takes at least 4; turn the sensor"


@pytest.mark.parametrize(
    ("says", "change"),
    [
        (
            FEW,
            lambda found: found._replace(
                presses=found.presses.only(np.arange(len(found.presses)) < 7)
            ),
        ),
        (ONE_SIDE, at_one_place),
        pytest.param(f"{NO_MOUNT}|mount: ", elsewhere, marks=pytest.mark.check),
        pytest.param(NO_MOUNT, swapped, marks=pytest.mark.check),
        pytest.param(NO_MOUNT, moved, marks=pytest.mark.check),
    ],
)
def test_presses_that_do_not_suffice_are_refused_with_the_cure(
    says: str, change: Callable[[Pressed], Pressed]
) -> None:
    with pytest.raises(SetupError, match=says):
        fit_of(change(pressed(0)))


def test_a_mount_that_stays_uncertain_is_refused_with_the_cure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calibrate, "KNOWN_MOUNT", np.zeros(3))
    with pytest.raises(SetupError, match=r"its yaw differs by \d+° now\), or give the object"):
        fit_of(pressed(0), given=False)


TAXELS, THRESHOLD = 6, 300.0  # counts of a touch


def found(*moves: tuple[float, float, int]) -> tuple[list[float], int]:
    """What is found of (counts, step of the sensor [m], scans) in turn: counts of each press, all
    where the sensor stood, and how many presses were not held."""
    finder, x, stood = PressFinder(TAXELS, 0.04, 0.001), 0.0, set()
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
