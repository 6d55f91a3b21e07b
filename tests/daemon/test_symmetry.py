"""Poses up to the object's symmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric, add_m

from ..rig.scenes import box, scene_of

poses = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3)).map(np.array)


@pytest.mark.parametrize("order", [0, 1, 2, 5])
@given(pose=poses, k=st.integers(0, 9))
def test_equivalent_poses_are_no_distance_apart(
    skin: Layout, order: int, pose: np.ndarray, k: int
) -> None:
    scene = scene_of(box(0.03, 0.06), skin, symmetry=order)
    metric = PoseMetric(scene)
    turn = 2.0 * np.pi * k / (order or 36)
    other = se2.compose(pose, se2.rotation_about(scene.centre, turn))
    assert np.isclose(metric.distance(pose, other), 0.0, atol=1e-6)
    assert add_m(scene, other, pose)[1] < 1e-6


def test_distance_is_the_surface_displacement_to_first_order(skin: Layout) -> None:
    scene = scene_of(box(0.03, 0.06), skin, symmetry=1)
    a, b = np.zeros(3), np.array([0.003, -0.004, 0.0])
    assert np.isclose(PoseMetric(scene).distance(a, b), 0.005)
    turn = np.array([0.0, 0.0, 0.01])
    assert np.isclose(PoseMetric(scene).distance(a, turn), 0.05 * 0.01)
    assert np.isclose(add_m(scene, turn, a)[0], 0.05 * 0.01, rtol=1e-3)


def test_plain_add_sees_what_the_symmetric_one_forgives(skin: Layout) -> None:
    scene = scene_of(box(0.03, 0.06), skin, symmetry=2)
    plain, symmetric = add_m(scene, np.array([0.0, 0.0, np.pi]), np.zeros(3))
    assert np.isclose(plain, 0.1)
    assert np.isclose(symmetric, 0.0, atol=1e-9)


def test_the_mean_of_half_turned_twins_is_either_and_not_between(skin: Layout) -> None:
    metric = PoseMetric(scene_of(box(0.03, 0.06), skin, symmetry=2))
    twins = np.array([[0.0, 0.0, 0.1], [0.002, 0.0, 0.1 - np.pi]])
    mean, cov = metric.mean(twins, np.ones(2), twins[0])
    assert np.allclose(mean, [0.001, 0.0, 0.1])
    assert np.allclose(np.diag(cov), [1e-6, 0.0, 0.0], atol=1e-12)


def test_modes_merge_equivalents_and_order_by_weight(skin: Layout) -> None:
    metric = PoseMetric(scene_of(box(0.03, 0.06), skin, symmetry=2))
    cloud = np.array([[0.0, 0, 0], [0.001, 0, np.pi - 0.01], [0.3, 0, 0.0], [0.3, 0.2, 1.0]])
    modes = metric.modes(cloud, np.array([0.3, 0.3, 0.25, 0.15]), 0.02, most=5, candidates=64)
    assert [round(mode.weight, 2) for mode in modes] == [0.6, 0.25, 0.15]
    assert sorted(modes[0].members) == [0, 1]


def test_no_mode_is_passed_over_for_where_it_stands_in_the_array(
    box_model: ObservationModel,
) -> None:
    """Of many equal particles the last are as good as the first."""
    poses = np.zeros((400, 3))
    poses[300:, 0] = 0.3
    weight = np.full(400, 1 / 400)
    for order in (slice(None), slice(None, None, -1)):
        found = PoseMetric(box_model.scene).modes(poses[order], weight, 0.02, 5, 64)
        assert [round(mode.weight, 6) for mode in found] == [0.75, 0.25]
