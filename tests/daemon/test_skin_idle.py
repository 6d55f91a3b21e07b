"""The idle capture, touched and untouched."""

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.skin.rest import WINDOW
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import NOISE, SimulatedSkin

MANY = layouts.load("wrap:modules=24,radius_m=0.08,rows=2")  # 480 taxels


def error(skin: Skin, simulated: SimulatedSkin) -> float:
    """The farthest that a baseline is off."""
    off = np.abs(skin.baseline - simulated.base)
    return float(np.delete(off, skin.faults()["untared_taxels"]).max())


@pytest.mark.parametrize("noise", [0.0, 0.5, 34.0, 130.0])
def test_an_untouched_skin_is_captured_in_one_window(noise: float) -> None:
    """By and large: one in some hundred windows is taken for touched by chance."""
    windows = []
    for seed in range(20):
        simulated = SimulatedSkin(MANY, seed, noise)
        skin = Skin(MANY, SkinConfig())
        while not skin.is_ready:
            skin.on_scan(simulated.scan())
        windows.append(skin.counters.scans / WINDOW)
        assert not skin.faults()["untared_taxels"]
        assert error(skin, simulated) < 0.5 + 6 * noise / np.sqrt(WINDOW)
    assert windows.count(1.0) >= 19


def test_a_touch_that_comes_and_goes_begins_the_capture_again(skin: Layout) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    list(simulated.lead(subject, 0.4))
    simulated.press[[3, 4]] = 4_000.0
    list(simulated.lead(subject, 0.8))
    simulated.press[:] = 0.0
    assert not subject.is_ready
    list(simulated.lead(subject, 2.0))
    assert not subject.faults()["untared_taxels"]
    assert error(subject, simulated) < 50.0


def test_taxels_that_are_held_since_the_capture_began_are_left_out_until_released(
    skin: Layout,
) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    list(simulated.lead(subject, 0.4))
    simulated.press[[3, 4]] = 4_000.0
    activation = simulated.run(subject, 10.0)
    assert subject.faults()["untared_taxels"] == [3, 4]
    assert not activation.live[[3, 4]].any()
    assert activation.live.sum() == len(skin) - 2
    assert not activation.z.any()
    simulated.press[:] = 0.0
    activation = simulated.run(subject, 6.0)
    assert activation.live.all()
    assert error(subject, simulated) < 50.0


def test_a_touch_held_before_and_through_the_capture_ends_with_its_release(skin: Layout) -> None:
    """Nothing tells it from a baseline until it goes; then the baseline is too high, and falls."""
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    simulated.press[[3, 4]] = 4_000.0
    simulated.run(subject, 2.0)
    simulated.press[:] = 0.0
    simulated.run(subject, 4.0)
    assert error(subject, simulated) < 50.0
    assert subject.counters.lowered == 2
    simulated.press[3] = 2_000.0
    assert simulated.run(subject, 0.5).z[3] == pytest.approx(0.1, abs=0.02)


def test_a_taxel_that_comes_to_life_gets_a_baseline_of_its_own(skin: Layout) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    simulated.fixed[7] = 0
    assert not simulated.run(subject, 2.0).live[7]
    del simulated.fixed[7]
    assert simulated.run(subject, 2.0).live[7]
    simulated.press[7] = 10_000.0
    assert simulated.run(subject, 0.5).z[7] == pytest.approx(0.5, abs=0.02)


def test_a_taxel_that_never_rests_gets_no_baseline(skin: Layout) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    for k in range(400):
        simulated.fixed[7] = 10_000 + 3_000 * (k % 3)
        activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(~activation.live).tolist() == [7]


def test_the_noise_of_each_taxel_is_its_own(skin: Layout) -> None:
    simulated = SimulatedSkin(skin)
    simulated.spread = np.where(np.arange(len(skin)) < 10, 3.0, 1.0)
    subject = Skin(skin, SkinConfig())
    simulated.run(subject, 11.0)
    assert subject.threshold == pytest.approx(6 * NOISE * simulated.spread, rel=0.25)


def test_out_of_contact_the_noise_is_known_ever_better_and_touches_do_not_raise_it(
    skin: Layout,
) -> None:
    simulated, subject = SimulatedSkin(skin, noise=100.0), Skin(skin, SkinConfig())
    simulated.run(subject, 1.5)
    early = np.abs(subject.threshold / 600.0 - 1.0).max()
    for k in range(40):
        simulated.press[[3, 4]] = 3_000.0 * (k % 2)
        simulated.run(subject, 3.0 + 4.0 * (k % 2 == 0))
    assert np.abs(subject.threshold / 600.0 - 1.0).max() < 0.12
    assert early > 0.2
