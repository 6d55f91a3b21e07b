"""What foam still reads after a release is no touch; whatever rises above it is one."""

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.model.activation import Activation
from taxeld.skin.foam import KEPT, Residue
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import PERIOD_S, SimulatedSkin

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")
FULL = SkinConfig().full_scale_counts
PRESSED, FIRM, LIGHT = 40, 15_000.0, 500.0
FAST_S, SLOW_S = 1.0, 25.0


@pytest.fixture
def begun() -> tuple[Skin, SimulatedSkin]:
    skin, foam = Skin(SKIN, SkinConfig()), SimulatedSkin(SKIN)
    foam.run(skin, 2.0)
    return skin, foam


def press(foam: SimulatedSkin, counts: float) -> None:
    foam.press[:] = 0.0
    foam.press[PRESSED] = counts


def scan(skin: Skin, foam: SimulatedSkin) -> Activation:
    activation = skin.on_scan(foam.scan())
    assert activation is not None
    return activation


def release(skin: Skin, foam: SimulatedSkin, kept: float, seconds: float) -> list[Activation]:
    """Lift off a firm press, of which a share stays, half of it for long."""
    found = []
    for k in range(round(seconds / PERIOD_S)):
        t = k * PERIOD_S
        press(foam, kept * FIRM * 0.5 * (np.exp(-t / FAST_S) + np.exp(-t / SLOW_S)))
        found.append(scan(skin, foam))
    return found


@pytest.mark.parametrize("kept", [0.01, 0.025, 0.09, 0.25])
def test_what_foam_keeps_of_a_press_is_no_touch(
    begun: tuple[Skin, SimulatedSkin], kept: float
) -> None:
    skin, foam = begun
    press(foam, FIRM)
    assert foam.run(skin, 1.0).z[PRESSED] > 0.5
    assert not any(activation.z.any() for activation in release(skin, foam, kept, 20.0))


def test_a_light_touch_where_foam_still_recovers_is_felt_at_once(
    begun: tuple[Skin, SimulatedSkin],
) -> None:
    skin, foam = begun
    press(foam, FIRM)
    foam.run(skin, 1.0)
    (*_, last) = release(skin, foam, 0.09, 0.5)
    assert not last.z.any()
    foam.press[PRESSED] += LIGHT
    assert scan(skin, foam).z[PRESSED] > 0.0


def test_what_a_light_touch_leaves_after_a_firm_one_is_no_touch(
    begun: tuple[Skin, SimulatedSkin],
) -> None:
    skin, foam = begun
    press(foam, FIRM)
    foam.run(skin, 1.0)
    press(foam, 0.0)
    foam.run(skin, 2.0)
    press(foam, 2000.0)
    assert foam.run(skin, 1.0).z[PRESSED] > 0.0
    press(foam, 400.0)  # more than the threshold, and much less than foam may keep of the first
    for _ in range(100):
        assert not scan(skin, foam).z.any()


def test_a_held_touch_is_felt_for_as_long_as_it_is_held(begun: tuple[Skin, SimulatedSkin]) -> None:
    skin, foam = begun
    press(foam, 1000.0)
    for _ in range(12):
        assert foam.run(skin, 10.0).z[PRESSED] > 0.02


def test_what_a_reading_may_hide_is_said_beside_it(begun: tuple[Skin, SimulatedSkin]) -> None:
    skin, foam = begun
    threshold = skin.threshold / FULL
    assert scan(skin, foam).floor == pytest.approx(threshold)
    press(foam, FIRM)
    foam.run(skin, 1.0)
    press(foam, 0.1 * FIRM)  # foam, or a touch that is lighter now
    activation = foam.run(skin, 0.5)
    assert activation.z[PRESSED] == 0.0
    assert activation.residue[PRESSED] == pytest.approx(0.1 * FIRM / FULL, abs=0.02)
    assert activation.floor[PRESSED] > 0.1 * FIRM / FULL


def test_a_touch_that_has_become_light_does_not_become_the_baseline(
    begun: tuple[Skin, SimulatedSkin],
) -> None:
    skin, foam = begun
    press(foam, FIRM)
    foam.run(skin, 1.0)
    press(foam, 0.1 * FIRM)
    before = skin.baseline[PRESSED]
    foam.run(skin, 60.0)
    assert skin.baseline[PRESSED] == pytest.approx(before, abs=10.0)


def test_neighbours_of_a_press_feel_what_they_feel(begun: tuple[Skin, SimulatedSkin]) -> None:
    skin, foam = begun
    press(foam, FIRM)
    foam.run(skin, 1.0)
    press(foam, 0.0)
    foam.press[PRESSED + 1] = LIGHT
    assert foam.run(skin, 0.3).z[PRESSED + 1] > 0.0


def test_a_press_is_over_when_it_has_fallen_to_its_share() -> None:
    foam = Residue(1)
    for over, pressed, level in (
        (50.0, False, 0.0),  # under the threshold
        (1000.0, True, 0.0),
        (1001.0 * KEPT, True, 0.0),
        (999.0 * KEPT, False, 999.0 * KEPT),
        (100.0, False, 100.0),
        (150.0, False, 100.0),  # within the threshold of the least since
        (201.0, True, 100.0),
        (100.0 + 0.9 * KEPT * 101.0, False, 100.0 + 0.9 * KEPT * 101.0),
        (-20.0, False, 0.0),
    ):
        foam.on_scan(np.array([over]), np.array([100.0]))
        assert (foam.pressed[0], foam.level[0]) == (pressed, pytest.approx(level))
