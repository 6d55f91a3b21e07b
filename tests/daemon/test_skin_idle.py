"""The idle capture, touched and untouched, the noise of each taxel, and both over restarts."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.skin.calibration import SkinState
from taxeld.skin.rest import WINDOW
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import NOISE, SimulatedSkin, begun

HELD = [3, 4]
MANY = layouts.load("wrap:modules=24,radius_m=0.08,rows=2")  # 480 taxels


def error(skin: Skin, simulated: SimulatedSkin) -> float:
    """The farthest that a baseline is off; infinite where one is not known."""
    if skin.faults()["untared_taxels"]:
        return np.inf
    return float(np.abs(skin.baseline - simulated.base).max())


@pytest.mark.parametrize("noise", [0.0, 0.5, 34.0, 130.0])
def test_an_untouched_skin_is_captured_in_one_window(noise: float) -> None:
    """By and large: one in some hundred windows is taken for touched by chance."""
    windows = []
    for seed in range(20):
        simulated, skin = SimulatedSkin(MANY, seed, noise), Skin(MANY, SkinConfig())
        while not skin.is_ready:
            skin.on_scan(simulated.scan())
        windows.append(skin.counters.scans / WINDOW)
        assert error(skin, simulated) < 0.5 + 6 * noise / np.sqrt(WINDOW)
    assert windows.count(1.0) >= 19


@pytest.mark.parametrize(
    ("before_s", "held_s", "lowered"),
    [
        (0.4, 0.8, 0),
        (0.4, 10.0, 0),
        # nothing tells it from a baseline until it goes; then the baseline is too high, and falls
        (0.0, 2.0, 2),
    ],
)
def test_a_touch_in_the_capture_is_left_out_and_one_held_through_it_ends_with_its_release(
    skin: Layout, before_s: float, held_s: float, lowered: int
) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    list(simulated.lead(subject, before_s))
    simulated.press[HELD] = 4_000.0
    activation = simulated.run(subject, held_s)
    untared = subject.faults()["untared_taxels"]
    assert untared == np.flatnonzero(~activation.live).tolist() == HELD * (not lowered)
    assert not activation.z.any()
    simulated.press[:] = 0.0
    assert simulated.run(subject, 6.0).live.all()
    assert subject.counters.lowered == lowered
    assert error(subject, simulated) < 50.0


def test_a_taxel_gets_a_baseline_of_its_own_when_it_comes_to_life_and_rests(skin: Layout) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    simulated.fixed[7] = 0
    assert not simulated.run(subject, 2.0).live[7]
    for k in range(200):
        simulated.fixed[7] = 12_000 + 3_000 * (k % 3)  # never as low as at rest
        activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(~activation.live).tolist() == [7]
    del simulated.fixed[7]
    simulated.run(subject, 4.0)
    simulated.press[7] = 10_000.0
    assert simulated.run(subject, 0.5).z[7] == pytest.approx(0.5, abs=0.02)


def test_each_taxels_noise_is_known_ever_better_and_touches_do_not_raise_it(
    skin: Layout,
) -> None:
    simulated, subject = begun(skin, 1.5)
    expected = 6 * NOISE * np.ones(len(skin))
    early = np.abs(subject.threshold / expected - 1.0).max()
    simulated.spread[:10], expected[:10] = 2.0, 12 * NOISE
    subject.tare()
    for k in range(40):
        simulated.press[HELD] = 3_000.0 * (k % 2)
        list(simulated.lead(subject, 3.0 + 4.0 * (k % 2 == 0)))
    assert np.abs(subject.threshold / expected - 1.0).max() < 0.12 < early


def stored(skin: Layout) -> tuple[SimulatedSkin, Skin, SkinState]:
    """A skin, one that has read it, and what that keeps."""
    simulated, subject = begun(skin, 4.0)
    state = subject.state()
    assert state is not None
    return simulated, subject, state


def restarted(skin: Layout, state: SkinState) -> Skin:
    subject = Skin(skin, SkinConfig())
    subject.restore(state)
    return subject


@pytest.mark.parametrize("warmth", [0.0, 1_000.0])
def test_a_restarted_skin_feels_a_held_touch_from_the_first_scan_though_it_has_warmed(
    skin: Layout, warmth: float
) -> None:
    simulated, before, state = stored(skin)
    simulated.coefficient, simulated.warmth = 0.5, lambda t: warmth + 0.0 * t
    simulated.press[HELD] = 5_000.0
    learned = replace(state, coefficient=np.full(4, 0.5), leak=np.full(4, 0.04))
    subject = restarted(skin, learned)
    activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(activation.z).tolist() == HELD
    assert activation.z[HELD] == pytest.approx(0.25, abs=0.01)
    assert activation.live.all()
    assert subject.threshold == pytest.approx(before.threshold, abs=0.1)


@pytest.mark.parametrize(
    "happened",
    [
        lambda simulated: simulated.base.__iadd__(3_000.0),
        lambda simulated: simulated.base.__isub__(3_000.0),
        lambda simulated: simulated.rng.shuffle(simulated.base),
        lambda simulated: simulated.press.__iadd__(5_000.0),
    ],
)
def test_a_baseline_that_the_skin_does_not_confirm_is_captured_anew(
    skin: Layout, happened: Callable[[SimulatedSkin], None]
) -> None:
    simulated, _, state = stored(skin)
    happened(simulated)
    subject = restarted(skin, state)
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 3.0)
    assert np.abs(subject.baseline - simulated.base - simulated.press).max() < 50.0


def test_a_dead_taxel_is_judged_when_it_answers_and_a_first_scan_may_be_torn(
    skin: Layout,
) -> None:
    simulated, _, state = stored(skin)
    subject = restarted(skin, state)
    torn = simulated.scan()
    few = (*torn.counts[:12], *[-1] * (len(torn.counts) - 12))
    assert subject.on_scan(replace(torn, counts=few)) is None
    simulated.fixed[7] = 0
    activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(~activation.live).tolist() == [7]
    del simulated.fixed[7]
    assert simulated.run(subject, 0.1).live.all()
