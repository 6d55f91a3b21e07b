"""A belief in few numbers."""

import numpy as np

from taxeld.estimator.memory import FLOOR, Prior
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric

SD = np.array([0.003, 0.001, 0.05])


def prior(model: ObservationModel, *means: float) -> Prior:
    rng = np.random.default_rng(0)
    poses = np.concatenate([rng.standard_normal((2000, 3)) * SD + [m, 0.0, 0.0] for m in means])
    weight = np.full(len(poses), 1.0 / len(poses))
    metric = PoseMetric(model.scene)
    return Prior(metric, poses, weight, metric.modes(poses, weight, 0.05, 5, 64))


def test_it_is_the_beliefs_gaussian(box_model: ObservationModel) -> None:
    made = prior(box_model, 0.0)
    at = np.array([[0.0, 0.0, 0.0], [0.003, 0.0, 0.0], [0.0, 0.002, 0.0], [0.0, 0.0, 0.1]])
    lost = made.log_density(at)[0] - made.log_density(at)
    assert np.allclose(lost, [0.0, 0.5, 1.6, 2.0], atol=0.25)


def test_equivalent_poses_are_equally_likely(box_model: ObservationModel) -> None:
    made = prior(box_model, 0.0)
    turned = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]])
    assert box_model.scene.symmetry == 2
    assert np.isclose(*made.log_density(turned), atol=1e-6)


def test_every_mode_stands(box_model: ObservationModel) -> None:
    made = prior(box_model, 0.0, 0.3)
    at = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.15, 0.0, 0.0]])
    near, far, between = made.log_density(at)
    assert np.isclose(near, far, atol=0.3)
    assert between < near - 10.0


def test_what_it_says_against_a_pose_is_bounded(box_model: ObservationModel) -> None:
    made = prior(box_model, 0.0)
    lost = made.ceiling - made.log_density(np.array([[9.0, 9.0, 1.0]]))
    assert np.isclose(lost, -np.log(FLOOR), atol=1e-6)
