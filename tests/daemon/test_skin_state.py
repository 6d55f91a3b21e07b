"""What a skin has learned, kept over restarts."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.skin.calibration import SkinState
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.simulated_skin import begun as rested

HELD = [3, 4]


def begun(skin: Layout) -> tuple[SimulatedSkin, Skin, SkinState]:
    """A skin, one that has read it, and what that keeps."""
    simulated, subject = rested(skin, 4.0)
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
    simulated, before, state = begun(skin)
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
    simulated, _, state = begun(skin)
    happened(simulated)
    subject = restarted(skin, state)
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 3.0)
    assert np.abs(subject.baseline - simulated.base - simulated.press).max() < 50.0


def test_a_dead_taxel_is_judged_when_it_answers_and_a_first_scan_may_be_torn(
    skin: Layout,
) -> None:
    simulated, _, state = begun(skin)
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


def test_tare_forgets_what_was_stored(skin: Layout) -> None:
    simulated, _, state = begun(skin)
    subject = restarted(skin, state)
    subject.tare()
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 2.0)
