"""Metrics against closed forms."""

import numpy as np
import pytest
import trimesh

from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld_training.limits.metrics import add, add_s, add_symmetric, sample_errors, summary
from taxeld_training.models.dataset import simulate
from taxeld_training.objects import scenes

SKIN = layouts.load("cylinder:rows=2,columns=16,radius_m=0.04,pitch_m=0.015")


@pytest.fixture(scope="module")
def model() -> ObservationModel:
    mesh = trimesh.creation.box((0.06, 0.1, 0.1))
    mesh.apply_translation([0.0, 0.0, 0.05])
    return ObservationModel(scenes.build(mesh, SKIN, 0.04), SKIN, 0.005)


def test_a_shift_counts_its_length_in_add_and_less_in_add_s(model: ObservationModel) -> None:
    truth = np.array([0.1, 0.2, 0.4])
    moved = truth + np.array([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0]])
    assert np.allclose(add(model.scene, moved, truth), [0.005, 0.0])
    assert np.allclose(add_symmetric(model.scene, moved, truth), [0.005, 0.0])
    nearest = add_s(model.scene, moved, truth)
    assert nearest[1] < 1e-12
    assert 0.0 < nearest[0] < 0.005


def test_a_half_turn_of_a_box_is_an_error_in_plain_add_alone(model: ObservationModel) -> None:
    truth = np.array([0.1, 0.2, 0.4])
    turned = se2.compose(truth, se2.rotation_about(model.scene.centre, np.pi))[None]
    assert add(model.scene, turned, truth)[0] > 0.05
    assert add_symmetric(model.scene, turned, truth)[0] < 1e-9
    assert add_s(model.scene, turned, truth)[0] < 0.002  # the surface points are 5 mm apart


def test_the_adds_are_those_of_the_daemon(model: ObservationModel) -> None:
    rng = np.random.default_rng(0)
    truth, poses = rng.uniform(-1, 1, 3), rng.uniform(-1, 1, (5, 3))
    both = np.array([add_m(model.scene, pose, truth) for pose in poses])
    assert np.allclose(add(model.scene, poses, truth), both[:, 0])
    assert np.allclose(add_symmetric(model.scene, poses, truth), both[:, 1])


def test_residuals_are_zero_at_the_truth_and_grow_with_the_error(model: ObservationModel) -> None:
    touch = simulate(model, 1, np.random.default_rng(0))
    truth, z = touch.pose[0], touch.activation[0].astype(float)
    direction = truth[:2] / np.linalg.norm(truth[:2])
    farther = truth + np.array([*(0.002 * direction), 0.0])
    poses = np.stack([truth, farther])
    errors = sample_errors(model, z, truth, poses, np.random.default_rng(0))
    assert errors.contact_residual_mm[0] == pytest.approx(0.0, abs=1e-9)
    assert 0.5 < errors.contact_residual_mm[1] <= 2.01
    assert errors.observation_residual[0] < 1e-6
    assert errors.observation_residual[1] > 0.05
    assert errors.add_mm[1] == pytest.approx(2.0)


def test_the_few_samples_of_costly_errors_are_drawn_from_all(model: ObservationModel) -> None:
    """A sampler may give its samples in order: the nearest first, or one mode after another."""
    touches = simulate(model, 40, np.random.default_rng(0))
    z, truth = touches.activation.astype(float), touches.pose
    ordered = [
        np.concatenate([np.repeat(pose[None], 50, 0), np.repeat(pose[None] + [0.05, 0, 0], 50, 0)])
        for pose in truth
    ]
    found = [
        summary(model, z, truth, samples, np.random.default_rng(1))
        for samples in (ordered, [poses[::-1] for poses in ordered])
    ]
    for figures in found:
        each = sample_errors(model, z[0], truth[0], ordered[0], np.random.default_rng(2))
        assert 0.0 < each.add_sym_mm.mean() < 50.0
        low, high = figures["add_sym_mm_ci"]
        assert low <= figures["add_sym_mm"] <= high
        assert low < 1.0
        assert high > 40.0  # half of the samples are 50 mm off
