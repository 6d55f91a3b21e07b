"""The fit of a calibration: what was put in comes out, and what cannot be known is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.model.response import GRID, Inverse, response
from taxeld.proposals import bundle
from taxeld.skin import calibration_search
from taxeld.skin.calibration_fit import Fit
from taxeld.skin.calibration_search import Known
from tests.daemon.pressed_skin import PLACED, PressedSkin

SKIN = layouts.load(SkinConfig().layout)
MODEL = bundle.load("box", SKIN, 0.005).model
GIVEN = Known(PLACED, given=True)
KNOWN_GAIN_SD = 0.06


def fitted(skin: PressedSkin, known: Known = GIVEN) -> Fit:
    noise = np.full(len(SKIN), skin.noise)
    return calibration_search.calibrate(MODEL, skin.presses(), noise, known)[0]


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 10_000))
def test_what_was_put_in_comes_out_within_the_stated_uncertainty(seed: int) -> None:
    skin = PressedSkin.drawn(MODEL, seed)
    fit = fitted(skin)
    off = fit.mount - skin.mount
    assert np.hypot(*off[:2]) < 3e-4
    assert abs(off[2]) < np.radians(0.3)
    assert (np.abs(off) < 4.0 * fit.mount_sd).all()
    gain_off = np.abs(fit.full_scale * fit.gain / (skin.full_scale * skin.gain) - 1.0)
    known = fit.gain_sd < KNOWN_GAIN_SD
    assert known.sum() >= 20
    assert np.median(gain_off[known]) < 0.03
    assert np.mean(gain_off < 2.0 * fit.gain_sd) > 0.85


@pytest.mark.parametrize("seed", [5])
def test_an_object_that_stands_some_millimetres_elsewhere_is_found_along(seed: int) -> None:
    skin = PressedSkin.drawn(MODEL, seed)
    near = se2.compose(PLACED, np.array([0.003, -0.003, 0.04]))
    fit = fitted(skin, Known(near, given=False))
    off = fit.mount - skin.mount
    assert np.hypot(*off[:2]) < 5e-4
    assert abs(off[2]) < np.radians(0.5)
    assert np.hypot(*(fit.object - PLACED)[:2]) < 1e-3


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
    fit, *_ = calibration_search.calibrate(MODEL, told, noise, GIVEN)
    known = fit.gain_sd < KNOWN_GAIN_SD
    off = fit.full_scale * fit.gain / (skin.full_scale * skin.gain) - 1.0
    assert np.median(np.abs(off[known])) < 0.03


def test_noise_that_is_written_is_what_readings_keep() -> None:
    skin = PressedSkin.drawn(MODEL, 5)
    presses = skin.presses()
    noise = np.full(len(SKIN), skin.noise)
    _, quiet, _ = calibration_search.calibrate(MODEL, presses, noise, GIVEN)
    rough = 0.06 * skin.full_scale * np.random.default_rng(2).standard_normal(presses.counts.shape)
    pressed = presses.counts > 0.1 * skin.full_scale
    worse = replace(presses, counts=presses.counts + np.where(pressed, rough, 0.0))
    _, loud, _ = calibration_search.calibrate(MODEL, worse, noise, GIVEN)
    assert loud > 1.2 * quiet


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


def test_a_response_is_undone_by_its_inverse() -> None:
    onset = np.array([-0.5, 0.0, 0.4, 2.5])
    inverse = Inverse(0.1, onset)
    for h in GRID[::16]:
        reading = response(np.full(4, h), 0.1, onset)
        assert inverse(reading) == pytest.approx(np.full(4, h), abs=4e-3)


@pytest.mark.parametrize("bend", [-0.3, 0.0, 0.1])
def test_a_reading_of_full_scale_is_exactly_full_depth_so_that_it_counts_as_saturated(
    bend: float,
) -> None:
    depth = Inverse(bend, np.linspace(-0.8, 2.5, 50))(np.full(50, 1.7))
    assert (depth == 1.0).all()
