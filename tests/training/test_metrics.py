"""Metrics against closed forms."""

import numpy as np

from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld_training.limits.metrics import LEVEL, add, coverage, summary


def test_the_add_is_that_of_the_daemon_and_a_shift_counts_its_length(
    ring_model: ObservationModel,
) -> None:
    rng = np.random.default_rng(0)
    truth, poses = rng.uniform(-1, 1, 3), rng.uniform(-1, 1, (5, 3))
    found = add(ring_model.scene, poses, truth)
    assert np.allclose(found, [add_m(ring_model.scene, pose, truth)[0] for pose in poses])
    moved = truth + np.array([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0]])
    assert np.allclose(add(ring_model.scene, moved, truth), [0.005, 0.0])
    figures = summary(ring_model.scene, truth[None], [moved], rng)
    assert np.allclose(list(figures["add_mm"].values()), [2.5, 0.0, 5.0])


def test_calibrated_samples_hold_the_truth_as_often_as_they_say_and_narrow_ones_do_not() -> None:
    rng = np.random.default_rng(0)
    centre = 0.1 * rng.standard_normal((400, 3))
    truth = centre + 0.01 * rng.standard_normal((400, 3))
    for spread, least, most in ((1.0, LEVEL - 0.05, LEVEL + 0.05), (0.2, 0.0, 0.7)):
        samples = list(centre[:, None] + spread * 0.01 * rng.standard_normal((400, 200, 3)))
        assert least < coverage(truth, samples, 0.1, rng).mean() < most
