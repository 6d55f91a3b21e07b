"""What a simulated foam adds while a press recedes, and what it keeps of one."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld_hil.scenario.mesh_config import PLAIN
from taxeld_hil.world.foam import Foam

LOOP = replace(PLAIN, hysteresis=(0.1, 0.1))
FAST = replace(PLAIN, residue=(0.02, 0.02), residue_s=1.0, loading_s=0.5)
SLOW = replace(PLAIN, residue_slow=(0.01, 0.01), residue_slow_s=30.0, loading_s=0.5)
ZERO, PRESS = np.zeros(1), np.array([0.8])


def foam(config: object, taxels: int = 1, seed: int = 0) -> Foam:
    return Foam(config, taxels, np.random.default_rng(seed))  # type: ignore[arg-type]


def loop(of: Foam, speed: float) -> Floats:
    """Two loops of one taxel between 0.2 and 0.8 of full, after a press; what each step reads."""
    there = np.arange(0.2, 0.8, 0.01)
    readings = np.concatenate([[0.0], there, there[::-1], there, there[::-1]])
    read = [of.press(np.array([r]), k * 0.01 / speed)[0] for k, r in enumerate(readings)]
    return np.array(read)[1:].reshape(4, -1)


def held(of: Foam, seconds: float, begun: float = 0.0) -> float:
    """Press a taxel for so long; → when it is released, to what is left of it."""
    of.press(ZERO, begun)
    for t in np.arange(0.05, seconds + 1e-9, 0.05):
        of.press(PRESS, begun + t)
    of.end()
    return begun + seconds


def test_the_hysteresis_loop_closes_and_does_not_depend_on_speed() -> None:
    slow, fast = loop(foam(LOOP), 0.01), loop(foam(LOOP), 1.0)
    np.testing.assert_array_equal(slow, fast)
    _, down, up_again, down_again = slow
    np.testing.assert_allclose(down, down_again)
    assert (down_again >= up_again[::-1] - 1e-12).all()
    assert down_again[30] == pytest.approx(1.1 * up_again[::-1][30])


def test_while_a_press_deepens_nothing_is_added() -> None:
    both = replace(LOOP, residue=(0.02, 0.02), residue_slow=(0.01, 0.01))
    np.testing.assert_allclose(loop(foam(both), 1.0)[0], np.arange(0.2, 0.8, 0.01))


@pytest.mark.parametrize(("config", "share", "tau_s"), [(FAST, 0.02, 1.0), (SLOW, 0.01, 30.0)])
def test_what_stays_of_a_long_press_is_its_share_and_decays_with_its_time_constant(
    config: object, share: float, tau_s: float
) -> None:
    of = foam(config)
    end = held(of, 10.0)
    read = [of.press(ZERO, end + t)[0] for t in (0.0, tau_s, 2.0 * tau_s)]
    np.testing.assert_allclose(read, 0.8 * share * np.exp([0.0, -1.0, -2.0]), rtol=1e-6)


def test_a_tap_leaves_less_than_a_press() -> None:
    left = []
    for seconds in (0.1, 0.5, 5.0):
        of = foam(SLOW)
        left.append(of.press(ZERO, held(of, seconds))[0])
    np.testing.assert_allclose(left, 0.008 * -np.expm1(np.array([-0.1, -0.5, -5.0]) / 0.5))


def test_what_presses_leave_adds_up_and_never_exceeds_its_share() -> None:
    of, left, begun = foam(SLOW), [], 0.0
    for _ in range(40):
        end = held(of, 0.2, begun)
        left.append(of.press(ZERO, end)[0])
        begun = end + 1.0
        of.press(ZERO, begun - 0.05)
    assert left[1] > 1.4 * left[0]
    assert max(left) < 0.008
    assert np.ptp(left[-5:]) < 1e-4, "what a press adds is then what is lost until the next"


def test_a_light_press_of_what_is_left_of_a_deep_one_is_read_as_it_is() -> None:
    of = foam(SLOW)
    end = held(of, 5.0)
    assert of.press(np.array([0.05]), end + 1.0)[0] == pytest.approx(0.05)


def test_half_of_the_spread_is_the_taxels_own_and_half_the_presses() -> None:
    """Over 60 skins of 40 taxels, 20 presses each."""
    config = replace(PLAIN, residue_slow=(0.01, 0.04), residue_slow_s=1e4, loading_s=0.01)
    logs = []
    for seed in range(60):
        of = foam(config, 40, seed)
        skin = []
        for k in range(20):
            of._left[:] = 0.0  # each press alone
            of.press(np.ones(40), 2.0 * k)
            of.press(np.ones(40), 2.0 * k + 1.0)
            skin.append(np.log(of.press(np.zeros(40), 2.0 * k + 1.0)))
            of.end()
        logs.append(skin)
    drawn = np.array(logs)  # (skins, presses, taxels)
    rate = np.log(4.0) / 1.2816
    assert np.median(drawn) == pytest.approx(np.log(0.01), abs=0.15)
    assert drawn.mean(axis=1).std(axis=1).mean() == pytest.approx(rate * np.sqrt(0.5), rel=0.15)
    assert drawn.mean(axis=2).std(axis=1).mean() == pytest.approx(rate * np.sqrt(0.5), rel=0.15)
