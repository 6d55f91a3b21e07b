"""The baseline over minutes: what it follows, and what it must not."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.skin.calibration import SkinState
from taxeld.skin.drift import HOLD_OFF_S
from taxeld.skin.rest import WINDOW
from taxeld.skin.skin import Skin
from tests.rig.simulated_skin import NOISE, SimulatedSkin, begun

MINUTE_S = 60.0
HELD = [3, 4, 19]
Spans = list[tuple[float, dict[str, Any]]]
"""Seconds, and what is changed of the simulated skin before them."""


def ramp(counts_a_minute: float) -> Callable[[float], float]:
    return lambda t: counts_a_minute * t / MINUTE_S


def pressed(counts: float, *taxels: int, rim: float = 0.0) -> dict[str, Any]:
    press = np.zeros(32)
    press[list(taxels or HELD)] = counts
    press[1] += rim
    return {"press": press}


def wave(t: float) -> float:
    return float(100.0 * np.sin(2 * np.pi * t / 90.0))


RIM: Spans = [(5 * MINUTE_S, pressed(4_000.0, 0, rim=150.0) | {"own_drift": ramp(50.0)})]
RELEASED: Spans = [(5.0, pressed(4_000.0, 3))]
WARM: Spans = [(10 * MINUTE_S, {"coefficient": 0.4, "warmth": ramp(60.0)})]
UNEXPLAINED: Spans = [
    (10 * MINUTE_S, {"own_drift": lambda t: min(ramp(30.0)(t), 300.0)}),
    (10 * MINUTE_S, {"warmth": wave}),
]
NONE: Spans = []


@pytest.mark.parametrize(
    ("before", "then", "taxels", "least", "most"),
    [
        (NONE, [(10 * MINUTE_S, pressed(400.0))], HELD, -NOISE, NOISE),
        (NONE, [(10 * MINUTE_S, pressed(15_000.0))], HELD, -NOISE, NOISE),
        # the rim is below its threshold, and must still be there when it rises
        (NONE, RIM, [0, 1], -1.0, 1.0),
        (NONE, RIM, [8], 150.0, np.inf),
        # after a release the skin comes back slowly
        (RELEASED, [(HOLD_OFF_S - 0.1, pressed(50.0, 3))], [3], 0.0, 0.0),
        (RELEASED, [(HOLD_OFF_S + 29.9, pressed(50.0, 3))], [3], 1.0, np.inf),
        # T0 sees a share of a press; what that does to a learned coefficient must not move z
        (
            [*WARM, (MINUTE_S, {"warmth": lambda _: 600.0})],
            [(1.5, pressed(8_000.0 * (k % 2))) for k in range(60)],
            HELD,
            -NOISE,
            NOISE,
        ),
        # where T0 explains nothing it moves nothing: a touch holds its baseline
        (UNEXPLAINED, [(MINUTE_S / 2, pressed(4_000.0))], HELD, -0.2 * NOISE, 0.2 * NOISE),
        # a pause of the skin is no slice
        ([(0.5, {})], [(2.0, {"t": 3_700.0})], slice(None), -2.0, 2.0),
    ],
)
def test_what_a_baseline_follows_and_what_holds_it(
    skin: Layout, before: Spans, then: Spans, taxels: Any, least: float, most: float
) -> None:
    simulated, subject = begun(skin, 6.0)
    for spans in (before, then):
        was = subject.baseline.copy()
        for seconds, changes in spans:
            vars(simulated).update(changes)
            simulated.run(subject, seconds)
    moved = (subject.baseline - was)[taxels]
    assert least <= moved.min() <= moved.max() <= most


@pytest.mark.parametrize("counts", [50.0, -50.0])
def test_drift_is_followed_and_no_touch(skin: Layout, counts: float) -> None:
    """Noise beyond the threshold is rare."""
    simulated, subject = begun(skin, 20.0)
    simulated.own_drift = ramp(counts)
    touched = [a is not None and a.z > 0.0 for a in simulated.lead(subject, 8 * MINUTE_S)]
    assert np.mean(touched) < 1e-4
    lag = simulated.base + simulated.own_drift(simulated.t - 100.0) - subject.baseline
    assert np.abs(lag).max() < 50.0 + NOISE


@pytest.mark.parametrize(
    ("lowered", "counts", "share"),
    [(0.0, 400.0, 0.6), (0.0, 15_000.0, 0.99), (-3_000.0, [0.0, 500.0, -1_000.0], 0.99)],
)
def test_a_touch_held_for_ten_minutes_does_not_fade(
    skin: Layout, lowered: float, counts: Any, share: float
) -> None:
    """Nor where the baseline was lowered, though a taxel reads just what it read before."""
    simulated, subject = begun(skin, 6.0)
    simulated.press[HELD] = lowered
    simulated.run(subject, 6.0)
    simulated.press[HELD] = counts
    felt = [a is not None and a.z[HELD] > 0.0 for a in simulated.lead(subject, 10 * MINUTE_S)]
    assert np.mean(felt, axis=0).min() > share


def test_a_skin_that_reads_too_low_for_a_while_feels_nothing_afterwards(skin: Layout) -> None:
    simulated, subject = begun(skin, 6.0)
    simulated.press[:8] = -3_000.0
    simulated.run(subject, 6.0)
    assert subject.counters.lowered == 8
    simulated.press[:] = 0.0
    assert not simulated.run(subject, 6.0).z.any()


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


PRESSED = [3, 4]
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
    simulated.press[PRESSED] = 4_000.0
    activation = simulated.run(subject, held_s)
    untared = subject.faults()["untared_taxels"]
    assert untared == np.flatnonzero(~activation.live).tolist() == PRESSED * (not lowered)
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
        simulated.press[PRESSED] = 3_000.0 * (k % 2)
        list(simulated.lead(subject, 3.0 + 4.0 * (k % 2 == 0)))
    assert np.abs(subject.threshold / expected - 1.0).max() < 0.12 < early


def stored(skin: Layout) -> tuple[SimulatedSkin, Skin, SkinState]:
    """A skin, one that has read it, and what that keeps."""
    simulated, subject = begun(skin, 4.0)
    return simulated, subject, subject.state()


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
    simulated.press[PRESSED] = 5_000.0
    learned = replace(state, coefficient=np.full(4, 0.5), leak=np.full(4, 0.04))
    subject = restarted(skin, learned)
    activation = subject.on_scan(simulated.scan())
    assert np.flatnonzero(activation.z).tolist() == PRESSED
    assert activation.z[PRESSED] == pytest.approx(0.25, abs=0.01)
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
    assert np.flatnonzero(~subject.on_scan(simulated.scan()).live).tolist() == [7]
    del simulated.fixed[7]
    assert simulated.run(subject, 0.1).live.all()
