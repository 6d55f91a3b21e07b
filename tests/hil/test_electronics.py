"""The effects between the depth of a press and a count: each keeps its own rule."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.config.toml_tables import Given
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.proposals import bundle
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.mesh_config import PLAIN
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.electronics import CrossTalk, Response, ThermalDrift
from taxeld_hil.world.world import COUNT_MAX, World, make_world
from taxeld_protocol.modules import wired

DEMO = replace(scenario.load("demo"), physics="scene")
MESH = replace(DEMO, physics="typical")
SKIN = layouts.load(DEMO.layout)
MODEL = bundle.load(DEMO.bundle, SKIN, 0.005).model
MODULES = wired(SKIN.uid.tolist())
SILENT = {"noise_counts": (0.0, 0.0)}
FAR = np.array([5.0, 5.0, 0.0])


def of(scenario_: Scenario, seed: int = 1) -> World:
    return make_world(scenario_, MODEL, MODULES, seed)


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
        read = Response(skin, 500, np.random.default_rng(0))(np.tile(h[:, None], 500))
        assert not read[0].any()
        np.testing.assert_allclose(read[h == 1.0], 1.0)
        assert (np.diff(read, axis=0) > 0.0).all(), (bend, onset)
    np.testing.assert_allclose(Response(PLAIN, 1, np.random.default_rng(0))(h[:, None])[:, 0], h)


def test_a_taxels_onset_is_by_how_much_steeper_its_response_begins() -> None:
    h = np.array([[0.0], [1e-6]])
    for onset in (0.5, 1.0, 2.0):
        skin = replace(PLAIN, bend=0.1, onset=(onset, onset))
        slope = Response(skin, 1, np.random.default_rng(0))(h)[1, 0] / 1e-6
        assert slope == pytest.approx(1.1 + onset - 1.0, rel=1e-4)


def test_cross_talk_adds_up_the_shares_of_all_presses_and_ends_at_the_module() -> None:
    share = CrossTalk(SKIN, (0.05, 0.05), np.random.default_rng(0))
    press = np.zeros(len(SKIN))
    press[[3, 4, 25]] = 500.0, 1000.0, 200.0
    read = share.add(press)
    np.testing.assert_allclose(read[[3, 4]], [550.0, 1025.0])
    np.testing.assert_allclose(read[[0, 1, 2, 5, 6, 7, 8, 9]], 75.0)
    np.testing.assert_allclose(np.delete(read[20:30], 5), 10.0)
    assert not read[10:20].any()
    assert not read[30:].any()


def test_cross_talk_of_a_pair_is_the_same_both_ways() -> None:
    share = CrossTalk(SKIN, (0.01, 0.067), np.random.default_rng(0))
    one = np.array([share.add(1000.0 * row) for row in np.eye(len(SKIN))])
    np.testing.assert_allclose(one, one.T)


def test_drift_is_never_faster_than_asked() -> None:
    drift = ThermalDrift(10, 3.0, 3600.0, 0.3, np.random.default_rng(0))
    counts = np.array([drift.counts(t) for t in np.arange(0.0, 7200.0, 60.0)])
    assert 2.5 < np.abs(np.diff(counts)).max() <= 3.0
    assert counts[0] == pytest.approx(drift.counts(3600.0))


def test_a_seed_has_the_same_truth_in_both_worlds_and_the_same_counts_again() -> None:
    scene, mesh, again = of(DEMO), of(MESH), of(MESH)
    np.testing.assert_array_equal(scene.truth, mesh.truth)
    pose = touching(mesh)
    times = 0.05 * np.arange(20)
    assert [mesh.counts(pose, t) for t in times] == [again.counts(pose, t) for t in times]
    assert mesh.counts(pose, 1.0) != of(MESH, 2).counts(pose, 1.0)


@pytest.mark.parametrize("full_scale", [20_000.0, 60_000.0])
def test_counts_stay_within_their_range_however_hard_the_press(full_scale: float) -> None:
    made = of(replace(MESH, full_scale_counts=full_scale, baseline_counts=20_000.0))
    for depth in (0.001, 0.0045, 0.005):
        counts = made.counts(touching(made, depth), depth)
        assert all(type(value) is int and 0 < value < COUNT_MAX for value in counts)
    assert max(counts) > 25_000


def test_temperature_channels_drift_with_the_taxels_and_hardly_read_a_press() -> None:
    quiet = replace(MESH, mesh=Given({**SILENT, "drift_counts_per_min": 60.0}))
    made = of(quiet)
    counts = np.array([made.counts(FAR, t) for t in np.arange(0.0, 1800.0, 60.0)])
    counts -= counts[0]
    t0 = counts[:, 0]
    assert np.ptp(t0) > 500
    share = counts[:, 1:11].T @ t0 / (t0 @ t0)
    assert np.corrcoef(counts[:, 1], t0)[0, 1] > 0.999
    assert 0.0 < share.std() < 1.0
    rise = np.array(made.counts(touching(made), 1740.0)) - np.array(made.counts(FAR, 1740.0))
    assert rise.max() > 5000
    assert rise[[0, 11, 22, 33]].max() < 0.1 * rise.max()


def test_with_every_effect_off_the_worlds_differ_by_geometry_alone() -> None:
    scene = of(replace(DEMO, mesh=Given(SILENT)))
    mesh = of(replace(MESH, mesh=Given({**asdict(PLAIN), **SILENT})))
    np.testing.assert_array_equal(scene.counts(FAR, 0.0), mesh.counts(FAR, 0.0))
    gaps = []
    for depth in (0.001, 0.002, 0.003, 0.004):
        pose = touching(scene, depth)
        one, other = np.array(scene.counts(pose, 0.0)), np.array(mesh.counts(pose, 0.0))
        gaps.append(np.abs(one - other)[one - np.array(scene.counts(FAR, 0.0)) > 500])
    assert np.median(np.concatenate(gaps)) < 0.1 * DEMO.full_scale_counts
