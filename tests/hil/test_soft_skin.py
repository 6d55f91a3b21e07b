"""The parts of a simulated soft skin: foam, electronics, and the skins that scenarios name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.config.gate import Given
from taxeld.model.response import response
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.scenario.staged import world_of
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.mesh_config import PLAIN, POOR, SKINS, STIFF, TYPICAL, MeshConfig
from taxeld_sim.world.skin import (
    COUNT_MAX,
    Foam,
    PerPress,
    SimulatedSkin,
    cross_talk,
    drawn,
    onsets,
)
from tests.hil.rig import DEMO, MODULES, SKIN

from ..rig.examples import examples

MESH = replace(DEMO, physics="typical")
SILENT = {"noise_counts": (0.0, 0.0)}


@pytest.mark.parametrize(
    ("bend", "onset"),
    [(0.1, (1.0, 2.7)), (-0.9, (1.0, 10.0)), (0.9, (0.1, 0.1)), (0.0, (0.1, 10.0))],
)
def test_a_response_is_exact_at_0_and_1_and_who_presses_harder_reads_more(
    bend: float, onset: tuple[float, float]
) -> None:
    h = np.linspace(0.0, 1.6, 200)
    skin = replace(PLAIN, bend=bend, onset=onset)
    read = response(h[:, None], bend, onsets(skin, 500, np.random.default_rng(0)))
    assert not read[0].any()
    np.testing.assert_allclose(read[h == 1.0], 1.0)
    assert (np.diff(read, axis=0) > 0.0).all()


def test_cross_talk_adds_up_the_shares_of_all_presses_and_ends_at_the_module() -> None:
    share = cross_talk(SKIN, (0.05, 0.05), np.random.default_rng(0))
    press = np.zeros(len(SKIN))
    press[[3, 4, 25]] = 500.0, 1000.0, 200.0
    read = press + share @ press
    np.testing.assert_allclose(read[[3, 4]], [550.0, 1025.0])
    np.testing.assert_allclose(read[[0, 1, 2, 5, 6, 7, 8, 9]], 75.0)
    np.testing.assert_allclose(np.delete(read[20:30], 5), 10.0)
    assert not read[10:20].any()
    assert not read[30:].any()
    share = cross_talk(SKIN, (0.01, 0.067), np.random.default_rng(0))
    np.testing.assert_array_equal(share, share.T)  # of a pair the same both ways


@pytest.mark.parametrize("full_scale", [20_000.0, 60_000.0])
def test_counts_stay_within_their_range_however_hard_the_press(full_scale: float) -> None:
    made = world_of(replace(MESH, full_scale_counts=full_scale, baseline_counts=20_000.0), 1)
    pressed = [made.step(t).counts for t in np.linspace(*made.touched_s()[0], 40)]
    assert all(type(value) is int and 0 < value < COUNT_MAX for row in pressed for value in row)
    assert np.max(pressed) > 25_000


def test_temperature_channels_drift_with_the_taxels_and_hardly_read_a_press() -> None:
    made = world_of(replace(MESH, mesh=Given({**SILENT, "drift_counts_per_min": 60.0})), 1)
    (begin, end), away = made.touched_s()[0], made.duration_s + np.arange(0.0, 1800.0, 60.0)
    still, *pressed = np.array([made.step(t).counts for t in np.linspace(begin, end, 40)])
    rise = np.max(pressed, axis=0) - still
    assert rise.max() > 5000
    assert rise[[0, 11, 22, 33]].max() < 0.1 * rise.max()
    counts = np.array([made.step(t).counts for t in away])
    counts -= counts[-1]  # foam has forgotten by then
    t0 = counts[5:, 0]
    assert np.ptp(t0) > 500
    assert 50 < np.abs(np.diff(t0)).max() <= 61, "never faster than asked, but for rounding"
    share = counts[5:, 1:11].T @ t0 / (t0 @ t0)
    assert np.corrcoef(counts[5:, 1], t0)[0, 1] > 0.999
    assert 0.0 < share.std() < 1.0


LOOP = replace(PLAIN, hysteresis=(0.1, 0.1))
FAST = replace(PLAIN, residue=(0.02, 0.02), residue_s=1.0, loading_s=0.5)
SLOW = replace(PLAIN, residue_slow=(0.01, 0.01), residue_slow_s=30.0, loading_s=0.5)
ALL = replace(LOOP, residue=(0.02, 0.02), residue_slow=(0.01, 0.01))
TAP = 0.8 * 0.02 * -np.expm1(-0.2)


@pytest.mark.parametrize(
    ("config", "moves", "reads"),
    [
        # hysteresis: more in the retreat, the same each time and at any speed, and nothing at 0
        (LOOP, [(0.8, 0.5), (0.2, 0.5)], 0.22),
        (LOOP, [(0.8, 9.0), (0.2, 9.0), (0.8, 9.0), (0.2, 9.0)], 0.22),
        (LOOP, [(0.8, 0.5), (0.2, 0.5), (0.8, 0.5)], 0.8),
        (LOOP, [(0.8, 0.5), (0.0, 0.5)], 0.0),
        (ALL, [(0.3, 0.5), (0.6, 0.5)], 0.6),  # while a press deepens nothing is added
        # residue: its share of a long press, which decays; less of a tap; no more of many
        (FAST, [(0.8, 0.1), (0.8, 10.0), (None, 0.0)], 0.8 * 0.02),
        (FAST, [(0.8, 0.1), (0.8, 10.0), (None, 1.0)], 0.8 * 0.02 * np.exp(-1.0)),
        (SLOW, [(0.8, 0.1), (0.8, 10.0), (None, 30.0)], 0.8 * 0.01 * np.exp(-1.0)),
        (FAST, [(0.8, 0.0), (0.8, 0.1), (None, 0.0)], TAP),
        (FAST, [(0.8, 0.1), (0.8, 9.0), (None, 0.0)] * 9, 0.8 * 0.02),
        # a light press of what is left of a deep one is read as it is
        (SLOW, [(0.8, 0.1), (0.8, 5.0), (None, 1.0), (0.05, 0.1)], 0.05),
    ],
)
def test_foam_reads_more_in_a_retreat_and_keeps_a_share_of_a_press(
    config: MeshConfig, moves: list[tuple[float | None, float]], reads: float
) -> None:
    """`moves`: to a reading within so many seconds; None: to 0 at once, and so long there."""
    foam, t, was = Foam(config, 1, np.random.default_rng(0)), 0.0, 0.0
    for to, seconds in moves:
        if to is None:
            foam.end()
        steps = 1 if to is None else max(round(seconds / 0.05), 1)
        for part in np.arange(1, steps + 1) / steps:
            reading = np.array([0.0 if to is None else was + (to - was) * part])
            read = foam.press(reading, t + seconds * part)[0]
        t, was = t + seconds, to or 0.0
    assert read == pytest.approx(reads, rel=1e-6)


AWAY_STEPS = 60
ROUNDING = 1e-6  # counts


@pytest.mark.parametrize("name", SKINS)
@given(
    seed=st.integers(0, 2**32),
    taxels=st.lists(st.integers(0, len(SKIN) - 1), min_size=1, max_size=12, unique=True),
    steps=st.integers(1, 40),
    pressed=st.floats(0.05, 1.0),
    period_s=st.floats(0.01, 2.0),
)
@examples(60)
def test_while_nothing_is_touched_no_reading_rises(
    name: str, seed: int, taxels: list[int], steps: int, pressed: float, period_s: float
) -> None:
    """Presses of any depth, on and off, on any taxels; then nothing. Foam keeps of each press its
    own share, and cross-talk couples what is kept: together they fade, on every taxel."""
    rng = np.random.default_rng(seed)
    depth_m = np.zeros((steps, len(SKIN)))
    on = rng.random((steps, len(taxels))) < pressed
    depth_m[:, taxels] = np.where(on, rng.uniform(0.0, 0.006, on.shape), 0.0)
    left = iter(depth_m / 0.005)

    def pressed_next(_seen: Poses, _sag_m: Floats, _turn: Floats) -> Floats:
        return next(left, np.zeros(len(SKIN)))

    skin = SimulatedSkin(Conditions(foam=name), SKIN, MODULES, pressed_next, rng)
    counts = np.array(
        [skin.press(np.zeros((1, 3)), period_s * k) for k in range(steps + AWAY_STEPS)]
    )
    assert (np.diff(counts[steps:], axis=0) <= ROUNDING).all()
    assert counts.min() >= 0.0


def test_a_lognormal_has_the_two_quantiles_that_it_is_given() -> None:
    rng = np.random.default_rng(1)
    many = [PerPress((2.0, 7.0), 10, rng).now for _ in range(10_000)]
    np.testing.assert_allclose(np.quantile(many, [0.5, 0.9]), [2.0, 7.0], rtol=0.05)
    assert not drawn((0.0, 0.0), np.ones(3)).any()
    np.testing.assert_allclose(drawn((3.0, 3.0), np.array([-5.0, 5.0])), 3.0)


def test_a_scenario_names_a_skin_and_replaces_single_keys_of_it(tmp_path: Path) -> None:
    def written(text: str) -> Scenario:
        (tmp_path / "s.toml").write_text(f'bundle = "box"\n{text}', encoding="utf-8")
        return scenario.load(str(tmp_path / "s.toml"))

    for text, skin in (("", TYPICAL), ('physics = "stiff"', STIFF), ('physics = "scene"', PLAIN)):
        assert written(text).skin == skin
    given = written('physics = "poor"\n[mesh]\nsag_m = [0.0019, 0.006]')
    assert given.skin == replace(POOR, sag_m=TYPICAL.sag_m)
    assert given.on("stiff").skin.sag_m == TYPICAL.sag_m, "its own keys go with it to another skin"
