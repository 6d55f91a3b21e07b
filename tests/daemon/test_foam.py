"""What foam still reads after a release is no touch; whatever rises above it is one."""

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.model.observation import Activation
from taxeld.skin.foam import KEPT, Residue
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import PERIOD_S, SimulatedSkin
from tests.rig.skins import SKIN

FULL = SkinConfig().full_scale_counts
PRESSED, FIRM, LIGHT = 40, 15_000.0, 500.0
FAST_S, SLOW_S = 1.0, 25.0


class Foam(SimulatedSkin):
    """A skin at rest, and the daemon's view of it."""

    def __init__(self) -> None:
        super().__init__(SKIN)
        self.skin = Skin(SKIN, SkinConfig())
        self.run(self.skin, 2.0)

    def hold(self, counts: float, seconds: float = 1.0) -> Activation:
        """Press one taxel alone; → the last activation."""
        self.press[:] = 0.0
        self.press[PRESSED] = counts
        return self.run(self.skin, seconds)


@pytest.fixture
def foam() -> Foam:
    return Foam()


@pytest.mark.parametrize("kept", [0.01, 0.025, 0.09, 0.25])
def test_what_foam_keeps_of_a_press_is_no_touch_and_a_light_touch_above_it_is_felt_at_once(
    foam: Foam, kept: float
) -> None:
    """Half of what it keeps stays for long."""
    assert foam.hold(FIRM).z[PRESSED] > 0.5
    for t in np.arange(0.0, 20.0, PERIOD_S):
        left = kept * FIRM * 0.5 * (np.exp(-t / FAST_S) + np.exp(-t / SLOW_S))
        assert not foam.hold(left, PERIOD_S).z.any()
    assert foam.hold(left + LIGHT, PERIOD_S).z[PRESSED] > 0.0


def test_noise_about_what_foam_keeps_is_no_touch() -> None:
    rng, kept, threshold = np.random.default_rng(1), 170.0, np.full(50, 200.0)
    foam = Residue(50)
    for over in (FIRM, 0.3 * FIRM, *[kept] * 1000):
        foam.on_scan(over + 30.0 * rng.standard_normal(50), threshold)
        assert over > kept or not foam.pressed.any()
    assert foam.level == pytest.approx(kept, abs=100.0)


def test_what_a_light_touch_leaves_after_a_firm_one_is_no_touch(foam: Foam) -> None:
    """More than the threshold, and much less than foam may keep of the first."""
    for counts, seconds, is_felt in ((FIRM, 1.0, True), (0.0, 2.0, False), (2000.0, 1.0, True)):
        assert (foam.hold(counts, seconds).z[PRESSED] > 0.0) == is_felt
    assert not any(foam.hold(400.0, PERIOD_S).z.any() for _ in range(100))


def test_a_held_touch_is_felt_for_as_long_as_it_is_held(foam: Foam) -> None:
    for _ in range(12):
        assert foam.hold(1000.0, 10.0).z[PRESSED] > 0.02


def test_an_activation_has_what_foam_may_hide_and_keep_and_no_baseline_follows_it(
    foam: Foam,
) -> None:
    threshold = foam.skin.threshold / FULL
    assert foam.run(foam.skin, PERIOD_S).floor == pytest.approx(threshold)
    foam.hold(FIRM)
    before = foam.skin.baseline[PRESSED]
    activation = foam.hold(0.1 * FIRM, 0.5)  # foam, or a touch that is lighter now
    assert activation.z[PRESSED] == 0.0
    assert activation.residue[PRESSED] == pytest.approx(0.1 * FIRM / FULL, abs=0.02)
    assert activation.floor[PRESSED] > 0.1 * FIRM / FULL
    foam.press[PRESSED + 1] = LIGHT
    assert foam.run(foam.skin, 0.3).z[PRESSED + 1] > 0.0
    foam.hold(0.1 * FIRM, 60.0)
    assert foam.skin.baseline[PRESSED] == pytest.approx(before, abs=10.0)


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
