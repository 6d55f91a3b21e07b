"""How samples enter the belief."""

from collections.abc import Callable

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.estimator import injection
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel

SD = np.array([0.001, 0.001, 0.02])


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def belief(log_weight: list[float]) -> Belief:
    n = len(log_weight)
    made = Belief(np.arange(3.0 * n).reshape(n, 3), np.array(log_weight), np.empty((n, 0)))
    pf.normalise(made)
    return made


def test_the_paper_replaces_the_least_at_the_mean_weight() -> None:
    made = belief(list(np.log([0.5, 0.3, 0.15, 0.05])))
    injection.paper(made, np.full((2, 3), 9.0))
    assert (made.pose[:2] != 9.0).all()
    assert (made.pose[2:] == 9.0).all()
    assert np.allclose(made.weight, np.array([0.5, 0.3, 0.25, 0.25]) / 1.3)


@pytest.mark.parametrize("count", [0, 1, 4, 9])
def test_any_number_may_be_injected(count: int) -> None:
    made = belief([0.0] * 4)
    injection.paper(made, np.full((count, 3), 9.0))
    assert (made.pose == 9.0).all(axis=1).sum() == min(count, 4)
    assert np.isclose(made.weight.sum(), 1.0)


def gaussians(*means: float) -> pf.Explain:
    """Scans that each say x is near a mean, with a sd of 1 mm, and nothing of y and θ but zero."""

    def explain(poses: np.ndarray) -> np.ndarray:
        each = [-0.5 * (((poses - [mean, 0.0, 0.0]) / SD) ** 2).sum(axis=1) for mean in means]
        return np.asarray(np.stack(each, axis=1))

    return explain


def samples(n: int, explain: pf.Explain, mean: float) -> Belief:
    pose = rng().standard_normal((n, 3)) * SD + [mean, 0.0, 0.0]
    return pf.equal(pose, explain(pose))


def test_annealed_samples_are_of_all_scans_together() -> None:
    """Samples that know the first of two Gaussian scans become the product of both."""
    explain = gaussians(0.0, 0.004)
    made = injection.anneal(
        samples(4000, explain, 0.0), np.array([1.0, 0.0]), np.ones(2), explain, rng()
    )
    assert np.isclose(made.pose[:, 0].mean(), 0.002, atol=1e-4)
    assert np.allclose(made.pose.std(axis=0) / SD, np.sqrt(0.5), atol=0.08)
    assert np.allclose(made.remembered, explain(made.pose))


def test_samples_that_know_everything_stay_what_they_are() -> None:
    explain = gaussians(0.0)
    made = injection.anneal(samples(4000, explain, 0.0), np.ones(1), np.ones(1), explain, rng())
    assert np.allclose(made.pose.std(axis=0) / SD, 1.0, atol=0.08)


def test_a_single_sample_survives_whatever_the_others_say() -> None:
    explain = gaussians(0.0, 50.0)
    made = injection.anneal(
        samples(1, explain, 0.0), np.array([1.0, 0.0]), np.ones(2), explain, rng()
    )
    assert np.isfinite(made.pose).all()
    assert np.isclose(made.weight.sum(), 1.0)


def test_what_explains_more_weighs_more() -> None:
    explain = gaussians(0.0)
    right, wrong = samples(50, explain, 0.0), samples(50, explain, 0.1)
    both = injection.merge(wrong, right, np.ones(1))
    assert both.weight[50:].sum() > 0.999
    assert np.isclose(both.weight.sum(), 1.0)


def test_a_particle_astray_beside_a_good_one_takes_no_weight_from_its_mode() -> None:
    explain = gaussians(0.0)
    right, astray = samples(200, explain, 0.0), samples(200, explain, 0.008)
    both = injection.merge(right, astray, np.ones(1))
    assert both.weight[200:].sum() < 0.05


def test_a_mode_that_both_samplings_found_is_not_doubled() -> None:
    two = both_modes()
    found_one, found_both = of_modes(two, 300, 0), of_modes(two, 300, 150)
    made = injection.merge(found_one, found_both, np.ones(1))
    assert 0.4 < made.weight[made.pose[:, 0] > 0.05].sum() < 0.6


def test_the_larger_sampling_of_two_does_not_outweigh_the_other() -> None:
    two = both_modes()
    few, many = of_modes(two, 40, 0), of_modes(two, 800, 800)
    made = injection.merge(few, many, np.ones(1))
    assert 0.3 < made.weight[made.pose[:, 0] > 0.05].sum() < 0.7


def test_of_two_modes_of_one_height_the_wider_has_more_evidence() -> None:
    wide = of_modes(lambda poses: bump(poses, 0.0, 0.003), 400, 0, 0.003)
    narrow = of_modes(lambda poses: bump(poses, 0.1, 0.001), 400, 400, 0.001)
    made = injection.merge(wide, narrow, np.ones(1))
    assert 15.0 < made.weight[:400].sum() / made.weight[400:].sum() < 45.0  # 3³ = 27


def bump(poses: Poses, x: float, sd: float) -> Floats:
    """(N, 1) logarithm of a Gaussian of height 1 at (x, 0, 0)."""
    off = poses / [sd, sd, 10.0 * sd] - [x / sd, 0.0, 0.0]
    return np.asarray(-0.5 * np.square(off).sum(axis=1, keepdims=True))


def both_modes() -> Callable[[Poses], Floats]:
    """Two alike, 0.1 m apart."""
    return lambda poses: np.logaddexp(bump(poses, 0.0, 0.002), bump(poses, 0.1, 0.002))


def of_modes(
    explain: Callable[[Poses], Floats], n: int, second: int, sd: float = 0.002
) -> pf.Belief:
    """n samples of the posterior, of which the last `second` are of the mode at 0.1 m."""
    pose = rng().standard_normal((n, 3)) * [sd, sd, 10.0 * sd]
    pose[n - second :, 0] += 0.1
    return pf.equal(pose, explain(pose))


def test_projection_brings_samples_onto_the_object_and_leaves_the_rest(
    box_model: ObservationModel,
) -> None:
    made = contacts.synthesise(box_model.scene, 0.04, 0.005, 200, rng()).pose
    assert np.allclose(injection.project(box_model, made), made, atol=1e-4)
    away = made + np.array([0.003, -0.002, 0.0])
    depth = -contacts.clearance(box_model.scene, 0.04, injection.project(box_model, away))
    assert np.mean((depth > -5e-4) & (depth < 0.0055)) > 0.97
