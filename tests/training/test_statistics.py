"""Intervals and paired tests, against closed forms and each other."""

import numpy as np
import pytest

from taxeld_training.jobs import statistics


def test_an_interval_of_a_mean_is_that_of_its_standard_error() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(5.0, 2.0, 400)
    low, high = statistics.of_mean([values], rng)
    assert (low + high) / 2 == pytest.approx(values.mean(), abs=0.05)
    assert high - low == pytest.approx(2 * 1.96 * 2.0 / 20.0, rel=0.2)


def test_groups_of_a_mean_weigh_alike_and_their_differences_are_no_noise() -> None:
    rng = np.random.default_rng(0)
    low, high = statistics.of_mean([np.zeros(1000), np.full(10, 1.0)], rng)
    assert low == high == 0.5


def test_an_interval_of_a_median_holds_it_and_rows_are_drawn_as_a_whole() -> None:
    rng = np.random.default_rng(0)
    readings = rng.normal(0.0, 1.0, (60, 1)) + np.zeros(100)  # a reading's samples are alike
    low, high = statistics.of_median(readings, rng)
    assert low < np.median(readings) < high
    assert high - low > 0.2  # as of 60 values, not of 6000


def test_a_share_of_none_is_not_certain() -> None:
    assert statistics.of_share([False] * 100) == pytest.approx((0.0, 0.037), abs=1e-3)
    assert statistics.of_share([True] * 50 + [False] * 50) == pytest.approx(
        (0.404, 0.596), abs=1e-3
    )


def test_pairs_tell_what_their_spread_hides() -> None:
    rng = np.random.default_rng(0)
    hard = rng.lognormal(0.0, 2.0, 64)  # what a reading costs any sampler
    better, worse = hard * 0.9, hard
    assert statistics.p_paired(better, worse) < 1e-6
    assert statistics.p_paired(worse, worse) == 1.0
    assert statistics.p_paired(worse, rng.permutation(worse)) > 0.05


def test_of_trials_only_those_that_differ_tell() -> None:
    first = [True] * 90 + [False] * 10
    second = [True] * 80 + [False] * 20
    assert statistics.p_share(first, second) == pytest.approx(2.0 * 0.5**10)
    assert statistics.p_share(first, first) == 1.0
