"""The filter's steps on ordinary and on degenerate beliefs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.estimator import particles as pf
from taxeld.estimator.particles import Belief


def belief(log_weight: list[float]) -> Belief:
    n = len(log_weight)
    weight = np.array(log_weight)
    made = Belief(np.arange(3.0 * n).reshape(n, 3), weight, np.empty((n, 0)), np.empty((n, 0)))
    pf.normalise(made)
    return made


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50))
def test_weights_sum_to_one_however_far_apart(values: list[float]) -> None:
    made = belief(values)
    assert np.isclose(made.weight.sum(), 1.0)
    assert 0.999 <= pf.effective_sample_size(made) <= len(values) + 1e-6


def test_evidence_is_the_mean_likelihood() -> None:
    made = belief([0.0] * 4)
    assert np.isclose(pf.reweight(made, np.log([1.0, 2.0, 3.0, 6.0])) or 0.0, np.log(3.0))
    assert np.allclose(made.weight, np.array([1, 2, 3, 6]) / 12)


@pytest.mark.parametrize(
    "likelihood", [[-np.inf] * 3, [np.nan] * 3, [0.0, np.nan, 0.0], [np.inf] * 3]
)
def test_impossible_likelihoods_are_a_result_and_change_nothing(likelihood: list[float]) -> None:
    made = belief([0.0, 1.0, 2.0])
    before = made.log_weight.copy()
    assert pf.reweight(made, np.array(likelihood)) is None
    assert np.array_equal(made.log_weight, before)


def test_one_survivor_takes_all() -> None:
    made = belief([0.0] * 5)
    pf.reweight(made, np.array([-np.inf, -np.inf, -3.0, -np.inf, -np.inf]))
    assert pf.effective_sample_size(made) == 1.0
    made = pf.resample(made, 5, rng())
    assert (made.pose == [6.0, 7.0, 8.0]).all()


@given(st.lists(st.floats(-20, 0), min_size=2, max_size=40), st.integers(0, 1000))
def test_resampling_draws_each_within_one_of_its_share(values: list[float], seed: int) -> None:
    made = belief(values)
    share = made.weight * len(values)
    made = pf.resample(made, len(values), np.random.default_rng(seed))
    drawn = np.bincount((made.pose[:, 0] / 3).astype(int), minlength=len(values))
    assert (np.abs(drawn - share) < 1.0 + 1e-6).all()
    assert np.allclose(made.weight, 1 / len(values))


def test_rejuvenation_samples_its_target() -> None:
    """Particles moved towards a Gaussian of 1 mm become one, whatever they began as."""
    made = pf.uniform(2000, (0.0, 0.0), 0.004, rng())
    sd = np.array([0.001, 0.001, 0.02])

    def explain(poses: np.ndarray) -> np.ndarray:
        return np.asarray(-0.5 * ((poses / sd) ** 2).sum(axis=1, keepdims=True))

    made.pose[:, 2] *= 0.02
    made.remembered = explain(made.pose)
    generator = rng()
    for _ in range(200):
        pf.rejuvenate(made, explain, lambda told: told.sum(axis=1), generator)
    assert np.allclose(made.pose.std(axis=0) / sd, 1.0, atol=0.1)
    assert np.allclose(made.remembered, explain(made.pose))


def test_occupied_cells_are_counted_once() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.001, 0.001, 0.01], [0.05, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert pf.occupied(poses) == 3
    assert pf.occupied(poses[:1]) == 1


def test_wider_beliefs_need_more_particles() -> None:
    """Fox 2003: at an error of 0.05 with 99 %, 100 cells need 1347 particles; one needs none."""
    assert pf.enough(1) == 1
    assert pf.enough(100) == pytest.approx(1347, abs=3)
    assert pf.enough(200) > pf.enough(100)


def test_enough_particles_keep_the_divergence_that_was_asked_for() -> None:
    cells = 20
    n, generator = pf.enough(cells), rng()
    divergences = []
    for _ in range(1000):
        p = np.bincount(generator.integers(cells, size=n), minlength=cells) / n
        divergences.append(np.sum(p[p > 0] * np.log(p[p > 0] * cells)))
    assert 0.98 < np.mean(np.array(divergences) < pf.KLD_ERROR) < 0.998
