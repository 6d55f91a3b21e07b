"""The steps that change a belief, and how samples enter it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import paper
from taxeld.estimator import particles as pf
from taxeld.estimator.bank import touching
from taxeld.estimator.particles import Explained, Particles
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel

SD = np.array([0.001, 0.001, 0.02])


def belief(log_weight: list[float]) -> Particles:
    made = pf.equal(np.arange(3.0 * len(log_weight)).reshape(-1, 3))
    made.log_weight = np.array(log_weight)
    pf.normalise(made)
    return made


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_evidence_is_the_mean_likelihood() -> None:
    made = belief([0.0] * 4)
    assert np.isclose(pf.reweight(made, np.log([1.0, 2.0, 3.0, 6.0])) or 0.0, np.log(3.0))
    assert np.allclose(made.weight, np.array([1, 2, 3, 6]) / 12)


@given(st.lists(st.floats(-20, 0) | st.just(-800.0), min_size=2, max_size=40), st.integers(0, 1000))
def test_resampling_draws_each_within_one_of_its_share(values: list[float], seed: int) -> None:
    made = belief(values)
    share = made.weight * len(values)
    made = pf.resample(made, len(values), np.random.default_rng(seed))
    drawn = np.bincount((made.pose[:, 0] / 3).astype(int), minlength=len(values))
    assert (np.abs(drawn - share) < 1.0 + 1e-6).all()
    assert np.allclose(made.weight, 1 / len(values))


def gaussians(*means: float) -> pf.Explain:
    """Scans that each say x is near a mean, with a sd of 1 mm, and nothing of y and θ but zero."""

    def explain(poses: Poses) -> Explained:
        each = [-0.5 * (((poses - [mean, 0.0, 0.0]) / SD) ** 2).sum(axis=1) for mean in means]
        return Explained(np.stack(each, axis=1), np.empty((len(poses), 0)))

    return explain


def everything(explained: Explained) -> Floats:
    return np.asarray(explained.scans.sum(axis=1))


def test_moves_sample_their_target() -> None:
    """Particles moved towards a Gaussian of 1 mm become one, whatever they began as."""
    made = pf.uniform(FilterConfig(particles=2000, half_width_m=0.01), rng())
    made.pose *= [0.4, 0.4, 0.02]
    explain, generator = gaussians(0.0), rng()
    made.explained = explain(made.pose)
    for _ in range(200):
        pf.rejuvenate(made, explain, everything, generator)
    assert np.allclose(made.pose.std(axis=0) / SD, 1.0, atol=0.1)
    assert np.allclose(made.explained.scans, explain(made.pose).scans)


def test_occupied_cells_are_counted_once() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.001, 0.001, 0.01], [0.05, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert pf.occupied(poses) == 3


def test_enough_particles_are_those_of_kld_sampling() -> None:
    """Fox 2003: at an error of 0.05 with 99 %, 100 cells need 1347 particles; one needs none."""
    assert pf.enough(100) == pytest.approx(1347, abs=3)


@pytest.mark.parametrize("count", [0, 1, 2, 4, 9])
def test_the_paper_replaces_the_least_at_the_mean_weight(count: int) -> None:
    before = np.array([0.5, 0.3, 0.15, 0.05])
    made = belief(np.log(before).tolist())
    paper.inject(made, np.full((count, 3), 9.0))
    left = max(4 - count, 0)
    assert (made.pose == 9.0).all(axis=1).tolist() == [False] * left + [True] * (4 - left)
    expected = np.append(before[:left], [0.25] * (4 - left))
    assert np.allclose(made.weight, expected / expected.sum())


def samples(n: int, mean: float) -> Poses:
    return np.asarray(rng().standard_normal((n, 3)) * SD + [mean, 0.0, 0.0])


@pytest.mark.parametrize("nats", [0.0, np.log(3.0), 60.0])
def test_importance_samples_share_the_weight_by_their_evidence(nats: float) -> None:
    one, other = (
        pf.equal(poses, gaussians(0.0)(poses)) for poses in (samples(400, 0.0), samples(100, 0.02))
    )
    both = pf.merge(one, -1.0, other, nats - 1.0)
    assert np.isclose(both.weight[:400].sum(), 1.0 / (1.0 + np.exp(nats)))
    assert np.isclose(both.weight.sum(), 1.0)
    assert np.array_equal(both.explained.scans[400:], other.explained.scans)


def test_projection_brings_samples_onto_the_object_and_leaves_the_rest(
    box_model: ObservationModel,
) -> None:
    made = contacts.synthesise(box_model.scene, 0.04, 0.005, 200, rng()).pose
    assert np.allclose(touching(box_model, made), made, atol=1e-4)
    away = made + np.array([0.003, -0.002, 0.0])
    depth = -contacts.clearance(box_model.scene, 0.04, touching(box_model, away))
    assert np.mean((depth > -5e-4) & (depth < 0.0055)) > 0.97
