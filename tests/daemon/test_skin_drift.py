"""The baseline over minutes: what it follows, and what it must not."""

from collections.abc import Callable

import numpy as np
import pytest

from taxeld.layout.layout import Layout
from taxeld.skin.drift import HOLD_OFF_S
from tests.rig.simulated_skin import NOISE, begun

MINUTE_S = 60.0
HELD = [3, 4, 19]


def ramp(counts_a_minute: float) -> Callable[[float], float]:
    return lambda t: counts_a_minute * t / MINUTE_S


@pytest.mark.parametrize("counts", [50.0, -50.0])
def test_drift_is_followed_and_no_touch(skin: Layout, counts: float) -> None:
    """Noise beyond the threshold is rare."""
    simulated, subject = begun(skin, 20.0)
    simulated.own_drift = ramp(counts)
    touched = [a is not None and a.z > 0.0 for a in simulated.lead(subject, 8 * MINUTE_S)]
    assert np.mean(touched) < 1e-4
    lag = simulated.base + simulated.own_drift(simulated.t - 100.0) - subject.baseline
    assert np.abs(lag).max() < 50.0 + NOISE


@pytest.mark.parametrize("counts", [400.0, 15_000.0])
def test_a_touch_held_for_ten_minutes_does_not_fade(skin: Layout, counts: float) -> None:
    simulated, subject = begun(skin, 6.0)
    simulated.press[HELD] = counts
    before = subject.baseline[HELD]
    felt = [a is not None and a.z[HELD] > 0.0 for a in simulated.lead(subject, 10 * MINUTE_S)]
    assert np.mean(felt, axis=0).min() > 0.6
    assert np.abs(subject.baseline[HELD] - before).max() < NOISE
    simulated.press[:] = 0.0
    assert not simulated.run(subject, 1.0).z.any()


def test_the_rim_of_a_held_touch_is_not_absorbed_and_far_from_it_drift_is_followed(
    skin: Layout,
) -> None:
    """The rim is below its threshold, and must still be there when it rises."""
    simulated, subject = begun(skin, 6.0)
    simulated.press[0], simulated.press[1] = 4_000.0, 150.0
    simulated.own_drift = ramp(50.0)
    before = subject.baseline.copy()
    simulated.run(subject, 5 * MINUTE_S)
    moved = subject.baseline - before
    assert np.abs(moved[:2]).max() < 1.0
    assert moved[8] > 150.0


def test_after_a_release_nothing_is_followed_for_a_while(skin: Layout) -> None:
    simulated, subject = begun(skin, 6.0)
    simulated.press[3] = 4_000.0
    simulated.run(subject, 5.0)
    simulated.press[3] = 50.0  # the skin has not come back yet
    before = subject.baseline[3]
    simulated.run(subject, HOLD_OFF_S - 0.1)
    assert subject.baseline[3] == before
    simulated.run(subject, 30.0)
    assert subject.baseline[3] > before


def test_a_press_that_comes_slowly_is_felt_all_the_same(skin: Layout) -> None:
    """Slower than the threshold in two time constants it would be lost without a bounded rate."""
    simulated, subject = begun(skin, 6.0)
    felt = 0.0
    for _ in range(round(2 * MINUTE_S / 0.05)):
        simulated.press[3] += 600.0 / MINUTE_S * 0.05
        felt = max(felt, simulated.run(subject, 0.05).z[3])
    assert felt > 0.02


@pytest.mark.parametrize("counts", [1_000.0, 8_000.0])
def test_a_touch_held_for_ten_minutes_while_the_skin_warms_keeps_its_size(
    skin: Layout, counts: float
) -> None:
    simulated, subject = begun(skin, 6.0)
    simulated.coefficient, simulated.warmth = 0.4, ramp(60.0)
    simulated.run(subject, 10 * MINUTE_S)
    simulated.press[HELD] = counts
    early = simulated.run(subject, 10.0).z[HELD]
    late = simulated.run(subject, 10 * MINUTE_S).z[HELD]
    drifted, noise = 0.4 * 60.0 * 10.0 / 20_000.0, NOISE / 20_000.0
    assert np.abs(late - early).max() < 0.25 * drifted + 4 * noise
    assert early == pytest.approx(counts / 20_000.0, abs=5 * noise)


def test_a_press_is_no_temperature(skin: Layout) -> None:
    """T0 sees a share of a press; what that does to a learned coefficient must not move z."""
    simulated, subject = begun(skin, 6.0)
    simulated.coefficient, simulated.warmth = 0.4, ramp(60.0)
    simulated.run(subject, 10 * MINUTE_S)
    simulated.warmth = lambda t: 600.0 + 0.0 * t
    simulated.run(subject, 60.0)
    before = subject.baseline[HELD]
    for k in range(60):
        simulated.press[HELD] = 8_000.0 * (k % 2)
        simulated.run(subject, 1.5)
    assert np.abs(subject.baseline[HELD] - before).max() < NOISE


def test_where_t0_explains_nothing_it_moves_nothing(skin: Layout) -> None:
    """A touch holds its baseline, which T0 alone could move then."""
    simulated, subject = begun(skin, 6.0)
    simulated.own_drift = lambda t: min(ramp(30.0)(t), 300.0)
    simulated.run(subject, 10 * MINUTE_S)
    simulated.warmth = lambda t: 100.0 * np.sin(2 * np.pi * t / 90.0)
    simulated.run(subject, 10 * MINUTE_S)
    simulated.press[HELD], before = 4_000.0, subject.baseline[HELD]
    simulated.run(subject, MINUTE_S / 2)
    assert np.abs(subject.baseline[HELD] - before).max() < 0.2 * NOISE


def test_a_pause_of_the_skin_is_no_slice(skin: Layout) -> None:
    simulated, subject = begun(skin, 6.5)
    simulated.t += 3_600.0
    before = subject.baseline.copy()
    simulated.run(subject, 2.0)
    assert np.abs(subject.baseline - before).max() < 2.0


def test_a_skin_that_reads_too_low_for_a_while_feels_nothing_afterwards(skin: Layout) -> None:
    simulated, subject = begun(skin, 6.0)
    simulated.press[:8] = -3_000.0
    simulated.run(subject, 6.0)
    assert subject.counters.lowered == 8
    simulated.press[:] = 0.0
    assert not simulated.run(subject, 6.0).z.any()


def test_a_touch_where_the_baseline_was_lowered_does_not_fade(skin: Layout) -> None:
    """Though one of the taxels reads just what it read before."""
    simulated, subject = begun(skin, 6.0)
    simulated.press[HELD] = -3_000.0
    simulated.run(subject, 6.0)
    simulated.press[HELD] = 0.0, 500.0, -1_000.0
    felt = [a is not None and a.z[HELD] > 0.0 for a in simulated.lead(subject, MINUTE_S)]
    assert np.all(felt)
