"""Metrics against closed forms."""

import numpy as np
import pytest

from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld_training.limits.metrics import add, add_symmetric, contact_residual, summary
from taxeld_training.models.dataset import simulate


def test_a_shift_counts_its_length_and_a_half_turn_of_a_box_in_plain_add_alone(
    ring_model: ObservationModel,
) -> None:
    scene, truth = ring_model.scene, np.array([0.1, 0.2, 0.4])
    moved = truth + np.array([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0]])
    assert np.allclose(add(scene, moved, truth), [0.005, 0.0])
    assert np.allclose(add_symmetric(scene, moved, truth), [0.005, 0.0])
    turned = se2.compose(truth, se2.rotation_about(scene.centre, np.pi))[None]
    assert add(scene, turned, truth)[0] > 0.05
    assert add_symmetric(scene, turned, truth)[0] < 1e-9


def test_the_adds_are_those_of_the_daemon(ring_model: ObservationModel) -> None:
    rng = np.random.default_rng(0)
    truth, poses = rng.uniform(-1, 1, 3), rng.uniform(-1, 1, (5, 3))
    both = np.array([add_m(ring_model.scene, pose, truth) for pose in poses])
    assert np.allclose(add(ring_model.scene, poses, truth), both[:, 0])
    assert np.allclose(add_symmetric(ring_model.scene, poses, truth), both[:, 1])


def test_residuals_are_zero_at_the_truth_and_grow_with_the_error(
    ring_model: ObservationModel,
) -> None:
    touch = simulate(ring_model, 1, np.random.default_rng(0))
    truth, z = touch.pose, touch.activation.astype(float)
    direction = truth[0, :2] / np.linalg.norm(truth[0, :2])
    farther = truth + np.array([*(0.002 * direction), 0.0])
    residual_m = contact_residual(ring_model, np.concatenate([truth, farther]), truth[0])
    assert residual_m[0] == pytest.approx(0.0, abs=1e-12)
    assert 0.0005 < residual_m[1] <= 0.00201
    found = [
        summary(ring_model, z, truth, [poses], np.random.default_rng(0))
        for poses in (truth, farther)
    ]
    assert found[0]["observation_residual"] < 1e-6
    assert found[1]["observation_residual"] > 0.05
    assert found[1]["add_mm"]["median"] == pytest.approx(2.0)


def test_the_few_samples_of_costly_errors_are_drawn_from_all(ring_model: ObservationModel) -> None:
    """A sampler may give its samples in order: the nearest first, or one mode after another."""
    touches = simulate(ring_model, 40, np.random.default_rng(0))
    z, truth = touches.activation.astype(float), touches.pose
    ordered = [
        np.concatenate([np.repeat(pose[None], 50, 0), np.repeat(pose[None] + [0.05, 0, 0], 50, 0)])
        for pose in truth
    ]
    for samples in (ordered, [poses[::-1] for poses in ordered]):
        figures = summary(ring_model, z, truth, samples, np.random.default_rng(1))
        low, high = figures["add_sym_mm_ci"]
        assert low <= figures["add_sym_mm"] <= high
        assert low < 1.0
        assert high > 40.0  # half of the samples are 50 mm off
