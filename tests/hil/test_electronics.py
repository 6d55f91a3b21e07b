"""The effects between the depth of a press and a count: each keeps its own rule."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.proposals import bundle
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.mesh_config import MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.electronics import Foam, ThermalDrift, condenser, coupling
from taxeld_hil.world.world import COUNT_MAX, World, make_world
from taxeld_protocol.modules import wired

DEMO = replace(scenario.load("demo"), physics="scene")
MESH = replace(DEMO, physics="mesh")
SKIN = layouts.load(DEMO.layout)
MODEL = bundle.load(DEMO.bundle, SKIN, 0.005).model
MODULES = wired(SKIN.uid.tolist())
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


def loop(foam: Foam, speed: float) -> Poses:
    """Two loops of one taxel between 1 and 4 mm, after a press; what each step reads."""
    there = np.arange(0.001, 0.004, 0.00005)
    depths = np.concatenate([[0.0], there, there[::-1], there, there[::-1]])
    read = [foam.press(np.array([d]), k * 0.00005 / speed)[0] for k, d in enumerate(depths)]
    return np.array(read)[1:].reshape(4, -1)


def test_the_hysteresis_loop_closes_and_does_not_depend_on_speed() -> None:
    slow, fast = loop(Foam(1, 0.1, 0.0, 1.0), 0.001), loop(Foam(1, 0.1, 0.0, 1.0), 0.1)
    np.testing.assert_array_equal(slow, fast)
    _, down, up_again, down_again = slow
    np.testing.assert_allclose(down, down_again)
    assert (down_again >= up_again[::-1] - 1e-12).all()
    assert down_again[len(down) // 2] == pytest.approx(1.1 * up_again[len(down) // 2], rel=0.03)


def test_while_a_press_deepens_the_depth_itself_is_read() -> None:
    first = loop(Foam(1, 0.1, 0.1, 2.0), 0.02)[0]
    np.testing.assert_allclose(first, np.arange(0.001, 0.004, 0.00005))


def test_what_remains_of_a_long_press_decays_with_its_time_constant() -> None:
    foam = Foam(1, 0.0, 0.1, 2.0)
    foam.press(np.array([0.004]), 0.0)
    foam.press(np.array([0.004]), 60.0)
    left = [foam.press(np.zeros(1), 60.0 + t)[0] for t in (0.0, 2.0, 40.0)]
    np.testing.assert_allclose(left, [0.0004, 0.0004 / np.e, 0.0], atol=1e-8)
    short = Foam(1, 0.0, 0.1, 2.0)
    short.press(np.array([0.004]), 0.0)
    short.press(np.array([0.004]), 0.1)
    assert short.press(np.zeros(1), 0.1)[0] < 0.1 * left[0]


def test_a_condenser_is_exact_at_0_and_1_and_rises_between() -> None:
    h = np.linspace(0.0, 1.6, 100)
    np.testing.assert_allclose(condenser(h, 0.0), h)
    bent = condenser(h, 0.3)
    assert bent[0] == 0.0
    assert condenser(np.ones(1), 0.3)[0] == pytest.approx(1.0)
    assert (np.diff(bent) > 0.0).all()
    assert (bent[1:60] < h[1:60]).all()


def test_cross_talk_keeps_the_sum_of_each_module() -> None:
    matrix = coupling(SKIN, 0.05)
    reading = np.random.default_rng(0).uniform(0.0, 1000.0, len(SKIN))
    module = SKIN.uid >> 4
    sums = np.bincount(module, matrix @ reading)
    np.testing.assert_allclose(sums, np.bincount(module, reading))
    np.testing.assert_allclose(matrix @ np.ones(len(SKIN)), 1.0)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert not matrix[module[:, None] != module].any()
    assert (matrix >= 0.0).all()
    np.testing.assert_array_equal(coupling(SKIN, 0.0), np.eye(len(SKIN)))
    one = np.zeros(len(SKIN))
    one[4] = 1.0
    assert np.flatnonzero(matrix @ one).tolist() == [3, 4, 5]


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
    quiet = replace(MESH, noise_counts=0.0, mesh=MeshConfig(drift_counts_per_min=60.0))
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
    off = MeshConfig(taxel_radius_m=0.0, sag_m=0.0, closing=0.0, hysteresis=0.0, creep=0.0,
                     cross_talk=0.0, drift_counts_per_min=0.0)  # fmt: skip
    scene = of(replace(DEMO, noise_counts=0.0))
    mesh = of(replace(MESH, noise_counts=0.0, mesh=off))
    np.testing.assert_array_equal(scene.counts(FAR, 0.0), mesh.counts(FAR, 0.0))
    gaps = []
    for depth in (0.001, 0.002, 0.003, 0.004):
        pose = touching(scene, depth)
        one, other = np.array(scene.counts(pose, 0.0)), np.array(mesh.counts(pose, 0.0))
        gaps.append(np.abs(one - other)[one - np.array(scene.counts(FAR, 0.0)) > 500])
    assert np.median(np.concatenate(gaps)) < 0.1 * DEMO.full_scale_counts
