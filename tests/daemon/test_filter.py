"""The filter's steps on ordinary and on degenerate beliefs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld import filter as pf
from taxeld.filter import Belief


def belief(log_weight: list[float]) -> Belief:
    n = len(log_weight)
    weight = np.array(log_weight)
    made = Belief(np.arange(3.0 * n).reshape(n, 3), weight, np.empty((n, 0)))
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
    pf.resample(made, rng())
    assert (made.pose == [6.0, 7.0, 8.0]).all()


@given(st.lists(st.floats(-20, 0), min_size=2, max_size=40), st.integers(0, 1000))
def test_resampling_draws_each_within_one_of_its_share(values: list[float], seed: int) -> None:
    made = belief(values)
    share = made.weight * len(values)
    pf.resample(made, np.random.default_rng(seed))
    drawn = np.bincount((made.pose[:, 0] / 3).astype(int), minlength=len(values))
    assert (np.abs(drawn - share) < 1.0 + 1e-6).all()
    assert np.allclose(made.weight, 1 / len(values))


def test_injection_replaces_the_least_at_the_mean_weight() -> None:
    made = belief(list(np.log([0.5, 0.3, 0.15, 0.05])))
    pf.inject(made, np.full((2, 3), 9.0), np.empty((2, 0)))
    assert (made.pose[:2] != 9.0).all()
    assert (made.pose[2:] == 9.0).all()
    assert np.allclose(made.weight, np.array([0.5, 0.3, 0.25, 0.25]) / 1.3)


def test_injected_samples_are_weighed_by_what_they_remember() -> None:
    made = Belief(np.zeros((4, 3)), np.log(np.full(4, 0.25)), np.full((4, 2), -1.0))
    pf.inject(made, np.ones((2, 3)), np.array([[-1.0, -1.0], [-50.0, -1.0]]))
    weight = np.sort(made.weight)
    assert weight[0] < 1e-20
    assert np.allclose(weight[1:], 1 / 3)


def test_no_injected_sample_outweighs_the_mean_n_times() -> None:
    made = Belief(np.zeros((4, 3)), np.log(np.full(4, 0.25)), np.full((4, 1), -1e4))
    pf.inject(made, np.ones((1, 3)), np.zeros((1, 1)))
    assert np.isclose(made.weight.max(), 1.0 / 1.75)


@pytest.mark.parametrize("count", [0, 1, 4, 9])
def test_any_number_may_be_injected(count: int) -> None:
    made = belief([0.0] * 4)
    pf.inject(made, np.full((count, 3), 9.0), np.empty((count, 0)))
    assert (made.pose == 9.0).all(axis=1).sum() == min(count, 4)
    assert np.isclose(made.weight.sum(), 1.0)


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
        pf.rejuvenate(made, explain, generator)
    assert np.allclose(made.pose.std(axis=0) / sd, 1.0, atol=0.1)
    assert np.allclose(made.remembered, explain(made.pose))


def test_without_a_memory_rejuvenation_is_roughening() -> None:
    made = belief([0.0] * 100)
    before = made.pose.copy()
    pf.rejuvenate(made, lambda poses: np.empty((len(poses), 0)), rng())
    assert (made.pose[:, :2] != before[:, :2]).all()
