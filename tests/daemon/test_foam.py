"""What foam still reads after a release is no touch; whatever else is read is one."""

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.skin.foam import RECOVERY_S, RESIDUE, Residue
from taxeld.skin.skin import Skin
from tests.daemon.simulated_skin import PERIOD_S, SimulatedSkin

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")
PRESSED, FIRM = 40, 15_000.0


@pytest.fixture
def begun() -> tuple[Skin, SimulatedSkin]:
    skin, foam = Skin(SKIN, SkinConfig()), SimulatedSkin(SKIN)
    foam.run(skin, 2.0)
    return skin, foam


def press(foam: SimulatedSkin, counts: float) -> None:
    foam.press[:] = 0.0
    foam.press[PRESSED] = counts


def test_what_foam_keeps_of_a_press_is_no_touch(begun: tuple[Skin, SimulatedSkin]) -> None:
    skin, foam = begun
    press(foam, FIRM)
    assert foam.run(skin, 1.0).z[PRESSED] > 0.5
    for scan in range(100):  # recovers within two seconds
        press(foam, 0.09 * FIRM * np.exp(-scan * PERIOD_S / 2.0))
        activation = skin.on_scan(foam.scan())
        assert activation is not None
        assert not activation.z.any()


def test_a_held_touch_is_felt_for_as_long_as_it_is_held(begun: tuple[Skin, SimulatedSkin]) -> None:
    skin, foam = begun
    press(foam, 1000.0)
    for _ in range(12):
        assert foam.run(skin, 10.0).z[PRESSED] > 0.02


def test_a_touch_much_lighter_than_the_last_is_felt_once_the_foam_has_recovered(
    begun: tuple[Skin, SimulatedSkin],
) -> None:
    skin, foam = begun
    press(foam, FIRM)
    foam.run(skin, 1.0)
    press(foam, 500.0)
    assert foam.run(skin, 0.5).z[PRESSED] == 0.0
    wait_s = RECOVERY_S * np.log(RESIDUE * FIRM / 500.0)
    assert foam.run(skin, wait_s + 0.5).z[PRESSED] > 0.0


def test_neighbours_of_a_press_feel_what_they_feel(begun: tuple[Skin, SimulatedSkin]) -> None:
    skin, foam = begun
    press(foam, FIRM)
    foam.run(skin, 1.0)
    press(foam, 0.0)
    foam.press[PRESSED + 1] = 500.0
    assert foam.run(skin, 0.3).z[PRESSED + 1] > 0.0


def test_it_fades_with_time_and_not_with_scans() -> None:
    foam = Residue(1)
    foam.after(np.array([1000.0]), 10.0)
    left = foam.after(np.zeros(1), 10.0 + RECOVERY_S)
    assert left[0] == pytest.approx(RESIDUE * 1000.0 / np.e)
    assert foam.after(np.zeros(1), 10.0) == pytest.approx(left)  # hubs end in any order
