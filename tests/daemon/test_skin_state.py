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

HELD = [3, 4]


def begun(skin: Layout) -> tuple[SimulatedSkin, Skin]:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    simulated.run(subject, 4.0)
    return simulated, subject


def state_of(subject: Skin) -> SkinState:
    state = subject.state()
    assert state is not None
    return state


def restarted(skin: Layout, state: SkinState) -> Skin:
    subject = Skin(skin, SkinConfig())
    subject.restore(state)
    return subject


def test_a_restarted_skin_feels_from_the_first_scan_though_it_is_held(skin: Layout) -> None:
    simulated, before = begun(skin)
    simulated.press[HELD] = 5_000.0
    subject = restarted(skin, state_of(before))
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
def test_a_baseline_that_the_skin_does_not_bear_out_is_captured_afresh(
    skin: Layout, happened: Callable[[SimulatedSkin], None]
) -> None:
    simulated, before = begun(skin)
    happened(simulated)
    subject = restarted(skin, state_of(before))
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 3.0)
    reads = simulated.base + simulated.press
    assert np.abs(subject.baseline - reads).max() < 50.0


def test_what_t0_explains_of_the_time_between_is_taken_off(skin: Layout) -> None:
    simulated, before = begun(skin)
    state = replace(state_of(before), coefficient=np.full(4, 0.5))
    simulated.coefficient, simulated.warmth = 0.5, lambda t: 1_000.0 + 0.0 * t
    simulated.press[HELD] = 5_000.0
    subject = restarted(skin, replace(state, leak=np.full(4, 0.04)))
    activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(activation.z).tolist() == HELD
    assert activation.z[HELD] == pytest.approx(0.25, abs=0.01)


def test_what_was_dead_is_judged_when_it_speaks_and_a_first_scan_may_be_torn(
    skin: Layout,
) -> None:
    simulated, before = begun(skin)
    subject = restarted(skin, state_of(before))
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
    simulated, before = begun(skin)
    subject = restarted(skin, state_of(before))
    subject.tare()
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 2.0)
