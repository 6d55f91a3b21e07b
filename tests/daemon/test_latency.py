"""Percentiles of the last scans, and the longest since start."""

import numpy as np

from taxeld.service.latency import LAST, Latencies


def test_nothing_measured_is_zeros() -> None:
    assert Latencies().percentiles() == {"p50": 0.0, "p99": 0.0, "max": 0.0}


def test_percentiles_are_of_the_last_scans_and_the_longest_is_since_start() -> None:
    values = np.random.default_rng(0).gamma(2.0, 300.0, 2 * LAST + 7)
    values[3] = 1e6
    latencies = Latencies()
    for scans, us in enumerate(values.tolist(), 1):
        latencies.add(us)
        if scans in (1, 10, LAST, len(values)):
            p50, p99 = np.percentile(values[max(scans - LAST, 0) : scans], (50, 99))
            longest = values[:scans].max()
            assert latencies.percentiles() == {"p50": p50, "p99": p99, "max": longest}
