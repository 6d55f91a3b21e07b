"""The baseline over minutes: what it follows, and what it must not."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from taxeld.layout.layout import Layout
from taxeld.skin.drift import HOLD_OFF_S
from tests.rig.simulated_skin import NOISE, begun

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
