"""How samples enter the belief."""

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.estimator import injection
from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel

SD = np.array([0.001, 0.001, 0.02])


def first(told: Floats) -> Floats:
    return np.asarray(told[:, 0])


def everything(told: Floats) -> Floats:
    return np.asarray(told.sum(axis=1))


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def belief(log_weight: list[float]) -> Belief:
    n = len(log_weight)
    made = Belief(
        np.arange(3.0 * n).reshape(n, 3), np.array(log_weight), np.empty((n, 0)), np.empty((n, 0))
    )
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
    made = injection.anneal(samples(4000, explain, 0.0), first, everything, explain, rng())
    assert np.isclose(made.pose[:, 0].mean(), 0.002, atol=1e-4)
    assert np.allclose(made.pose.std(axis=0) / SD, np.sqrt(0.5), atol=0.08)
    assert np.allclose(made.remembered, explain(made.pose))


def test_samples_that_know_everything_stay_what_they_are() -> None:
    explain = gaussians(0.0)
    made = injection.anneal(samples(4000, explain, 0.0), first, everything, explain, rng())
    assert np.allclose(made.pose.std(axis=0) / SD, 1.0, atol=0.08)


def test_a_single_sample_survives_whatever_the_others_say() -> None:
    explain = gaussians(0.0, 50.0)
    made = injection.anneal(samples(1, explain, 0.0), first, everything, explain, rng())
    assert np.isfinite(made.pose).all()
    assert np.isclose(made.weight.sum(), 1.0)


@pytest.mark.parametrize("nats", [0.0, np.log(3.0), 60.0])
def test_opinions_share_the_weight_by_their_evidence(nats: float) -> None:
    explain = gaussians(0.0)
    one, other = samples(400, explain, 0.0), samples(100, explain, 0.02)
    both = injection.merge(one, -1.0, other, nats - 1.0)
    assert np.isclose(both.weight[:400].sum(), 1.0 / (1.0 + np.exp(nats)))
    assert np.isclose(both.weight.sum(), 1.0)
    assert np.array_equal(both.remembered[400:], other.remembered)


def test_projection_brings_samples_onto_the_object_and_leaves_the_rest(
    box_model: ObservationModel,
) -> None:
    made = contacts.synthesise(box_model.scene, 0.04, 0.005, 200, rng()).pose
    assert np.allclose(injection.project(box_model, made), made, atol=1e-4)
    away = made + np.array([0.003, -0.002, 0.0])
    depth = -contacts.clearance(box_model.scene, 0.04, injection.project(box_model, away))
    assert np.mean((depth > -5e-4) & (depth < 0.0055)) > 0.97
