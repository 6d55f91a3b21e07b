"""The fit of a calibration: what was put in comes out, and what cannot be known is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.arrays import Floats
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.proposals import bundle
from taxeld_hil.calibration.calibrate import Known, best_fit
from taxeld_hil.calibration.fit import FitResult
from tests.hil.pressed_skin import PLACED, PressedSkin

SKIN = layouts.load(SkinConfig().layout)
MODEL = bundle.load("box", SKIN, 0.005).model
GIVEN = Known(PLACED, given=True)
KNOWN_GAIN_SD = 0.06


def fitted(skin: PressedSkin, known: Known = GIVEN) -> FitResult:
    noise = np.full(len(SKIN), skin.noise)
    return best_fit(MODEL, skin.presses(), noise, known)[0]


def gain_off(fit: FitResult, skin: PressedSkin) -> Floats:
    """(M,) relative, of what each taxel reads at full depth."""
    counts = np.exp(fit.value.log_full + fit.value.log_gain)
    return np.abs(counts / (skin.full_scale * skin.gain) - 1.0)


@settings(max_examples=3, deadline=None)
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


@pytest.mark.parametrize("seed", [5])
def test_an_object_that_stands_some_millimetres_elsewhere_is_found_along(seed: int) -> None:
    skin = PressedSkin.drawn(MODEL, seed)
    near = se2.compose(PLACED, np.array([0.003, -0.003, 0.04]))
    fit = fitted(skin, Known(near, given=False))
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


def test_noise_that_is_written_is_what_readings_keep() -> None:
    skin = PressedSkin.drawn(MODEL, 5)
    presses = skin.presses()
    noise = np.full(len(SKIN), skin.noise)
    _, quiet = best_fit(MODEL, presses, noise, GIVEN)
    rough = 0.06 * skin.full_scale * np.random.default_rng(2).standard_normal(presses.counts.shape)
    pressed = presses.counts > 0.1 * skin.full_scale
    worse = replace(presses, counts=presses.counts + np.where(pressed, rough, 0.0))
    _, loud = best_fit(MODEL, worse, noise, GIVEN)
    assert loud.sigma > 1.2 * quiet.sigma


def refused(skin: PressedSkin, known: Known = GIVEN) -> str:
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
    assert message.startswith("calibrate: the presses are on 1 of the skin's sides")
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
    message = refused(fixed, Known(near, given=False))
    assert message.startswith("calibrate: the mount cannot be told (sd ")
    assert "turn the sensor between presses (its yaw differs by 0° now), or give" in message


def test_an_object_that_is_not_where_it_is_said_to_be_is_refused() -> None:
    skin = PressedSkin.drawn(MODEL, 2)
    wrong = Known(se2.compose(PLACED, np.array([0.03, 0.02, 0.5])), given=True)
    message = refused(skin, wrong)
    assert "explains the presses" in message or "cannot be told" in message


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
