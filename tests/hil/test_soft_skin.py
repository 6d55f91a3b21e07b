"""The parts of a simulated soft skin: foam, electronics, and the skins that scenarios name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.config.gate import Given
from taxeld.model import se2
from taxeld.model.response import response
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.mesh_config import PLAIN, POOR, SKINS, STIFF, TYPICAL, MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.skin import (
    COUNT_MAX,
    Foam,
    PerPress,
    SimulatedSkin,
    cross_talk,
    drawn,
    onsets,
)
from taxeld_hil.world.world import World, world_of
from tests.hil.rig import DEMO, MODEL, MODULES, SKIN

from ..rig.examples import examples

MESH = replace(DEMO, physics="typical")
SILENT = {"noise_counts": (0.0, 0.0)}
FAR = np.array([5.0, 5.0, 0.0])


def scanned(made: World, pose: Poses, t: float) -> list[int]:
    """A scan with the sensor at a pose."""
    seen = se2.compose(se2.inverse(pose), made.truth)
    return made.skins[0].counts(seen[None], t, touching=False)


def touching(made: World, depth_m: float = 0.003) -> Poses:
    """A sensor pose that presses the box's face, column 0 ahead."""
    for gap in np.arange(0.15, 0.0, -0.0002):
        behind = MODEL.scene.centre - np.array([gap, 0.0])
        pose = se2.compose(made.truth, np.array([*behind, 0.0]))
        seen = se2.compose(se2.inverse(pose), made.truth)
        if MODEL.activation(seen[None]).max() * 0.005 >= depth_m:
            return pose
    raise AssertionError("the object is not there")


def test_a_response_is_exact_at_0_and_1_and_who_presses_harder_reads_more() -> None:
    h = np.linspace(0.0, 1.6, 200)
    for bend, onset in (
        (0.1, (1.0, 2.7)),
        (-0.9, (1.0, 10.0)),
        (0.9, (0.1, 0.1)),
        (0.0, (0.1, 10.0)),
    ):
        skin = replace(PLAIN, bend=bend, onset=onset)
        read = response(h[:, None], bend, onsets(skin, 500, np.random.default_rng(0)))
        assert not read[0].any()
        np.testing.assert_allclose(read[h == 1.0], 1.0)
        assert (np.diff(read, axis=0) > 0.0).all(), (bend, onset)
    assert not onsets(PLAIN, 1, np.random.default_rng(0)).any()


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
    for depth in (0.001, 0.0045, 0.005):
        counts = scanned(made, touching(made, depth), depth)
        assert all(type(value) is int and 0 < value < COUNT_MAX for value in counts)
    assert max(counts) > 25_000


def test_temperature_channels_drift_with_the_taxels_and_hardly_read_a_press() -> None:
    quiet = replace(MESH, mesh=Given({**SILENT, "drift_counts_per_min": 60.0}))
    made = world_of(quiet, 1)
    counts = np.array([scanned(made, FAR, t) for t in np.arange(0.0, 1800.0, 60.0)])
    counts -= counts[0]
    t0 = counts[:, 0]
    assert np.ptp(t0) > 500
    assert 50 < np.abs(np.diff(t0)).max() <= 61, "never faster than asked, but for rounding"
    share = counts[:, 1:11].T @ t0 / (t0 @ t0)
    assert np.corrcoef(counts[:, 1], t0)[0, 1] > 0.999
    assert 0.0 < share.std() < 1.0
    rise = np.array(scanned(made, touching(made), 1740.0)) - np.array(scanned(made, FAR, 1740.0))
    assert rise.max() > 5000
    assert rise[[0, 11, 22, 33]].max() < 0.1 * rise.max()


LOOP = replace(PLAIN, hysteresis=(0.1, 0.1))
FAST = replace(PLAIN, residue=(0.02, 0.02), residue_s=1.0, loading_s=0.5)
SLOW = replace(PLAIN, residue_slow=(0.01, 0.01), residue_slow_s=30.0, loading_s=0.5)
ZERO, PRESS = np.zeros(1), np.array([0.8])


def foam(config: MeshConfig) -> Foam:
    return Foam(config, 1, np.random.default_rng(0))


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
    config: MeshConfig, share: float, tau_s: float
) -> None:
    of = foam(config)
    end = held(of, 10.0)
    read = [of.press(ZERO, end + t)[0] for t in (0.0, tau_s, 2.0 * tau_s)]
    np.testing.assert_allclose(read, 0.8 * share * np.exp([0.0, -1.0, -2.0]), rtol=1e-6)
    tap = foam(config)
    assert tap.press(ZERO, held(tap, 0.1))[0] == pytest.approx(0.8 * share * -np.expm1(-0.2))


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

    def pressed_next(_seen: Poses, _sag_m: Floats) -> Floats:
        return next(left, np.zeros(len(SKIN)))

    skin = SimulatedSkin(Conditions(foam=name), SKIN, MODULES, pressed_next, rng)
    counts = np.array(
        [skin.press(np.zeros((1, 3)), period_s * k) for k in range(steps + AWAY_STEPS)]
    )
    assert (np.diff(counts[steps:], axis=0) <= ROUNDING).all()
    assert counts.min() >= 0.0


def written(text: str, place: Path) -> Scenario:
    (place / "s.toml").write_text(f'bundle = "box"\n{text}', encoding="utf-8")
    return scenario.load(str(place / "s.toml"))


def test_a_lognormal_has_the_two_quantiles_that_it_is_given() -> None:
    values = drawn((2.0, 7.0), np.random.default_rng(0).standard_normal(100_000))
    np.testing.assert_allclose(np.quantile(values, [0.5, 0.9]), [2.0, 7.0], rtol=0.02)
    rng = np.random.default_rng(1)
    many = np.concatenate([PerPress((2.0, 7.0), 10, rng).now for _ in range(10_000)])
    np.testing.assert_allclose(np.quantile(many, [0.5, 0.9]), [2.0, 7.0], rtol=0.05)
    assert not drawn((0.0, 0.0), np.ones(3)).any()
    np.testing.assert_allclose(drawn((3.0, 3.0), np.array([-5.0, 5.0])), 3.0)


def test_a_scenario_names_a_skin_and_replaces_single_keys_of_it(tmp_path: Path) -> None:
    assert written("", tmp_path).skin == TYPICAL
    assert written('physics = "stiff"', tmp_path).skin == STIFF
    given = written('physics = "poor"\n[mesh]\nsag_m = [0.0019, 0.006]', tmp_path)
    assert given.skin.sag_m == TYPICAL.sag_m
    assert given.skin.residue_slow == POOR.residue_slow
    assert given.on("stiff").skin.sag_m == TYPICAL.sag_m, "its own keys go with it to another skin"
    assert written('physics = "scene"', tmp_path).skin == PLAIN
