"""Histograms of latency: exact counts, percentiles from above, cyclictest's form."""

import json
import time
from email.utils import format_datetime, parsedate_to_datetime

import numpy as np
import pytest

from taxeld.service.latency import BOUND_US, Histogram, Latencies


def filled(values: list[float]) -> Histogram:
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    return histogram


def test_every_duration_is_counted_once() -> None:
    histogram = filled([0.0, 0.9, 17.0, 17.99, 18.0, BOUND_US - 0.5, BOUND_US, 1e9])
    assert histogram.counts() == {"0": 2, "17": 2, "18": 1, str(BOUND_US - 1): 1}
    assert histogram.overflow == 2
    assert histogram.cycles == sum(histogram.counts().values()) + histogram.overflow
    assert (histogram.min_us, histogram.max_us) == (0.0, 1e9)


def test_a_histogram_tells_its_dates_as_cyclictest_does() -> None:
    before = time.time()
    told = Latencies(("filter",)).as_cyclictest()
    for name in ("start_time", "end_time"):
        date = parsedate_to_datetime(told[name])
        assert format_datetime(date) == told[name], "RFC 2822"
        assert before - 1.0 <= date.timestamp() <= time.time()


def test_nothing_measured_is_zeros() -> None:
    empty = Histogram()
    assert (empty.quantiles_us(), empty.counts()) == ([0.0, 0.0], {})
    assert (empty.min_us, empty.mean_us, empty.max_us) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_percentiles_are_those_of_the_values_to_a_microsecond(seed: int) -> None:
    values = np.random.default_rng(seed).gamma(2.0, 300.0, 5000)
    exact = np.quantile(values, (0.5, 0.99), method="inverted_cdf")
    found = filled(values.tolist()).quantiles_us()
    assert (found >= exact).all()
    assert (found <= exact + 1.0).all()


def test_percentiles_in_the_overflow_are_the_maximum() -> None:
    assert filled([1.0] * 9 + [2.0 * BOUND_US]).quantiles_us() == [2.0, 2.0 * BOUND_US]
    assert filled([3.25]).quantiles_us() == [3.25, 3.25]


def test_the_file_is_what_readers_of_cyclictest_expect() -> None:
    latencies = Latencies(("source", "total"))
    for us in (1.5, 2.5, 2.7, 2.0 * BOUND_US):
        latencies.add({"source": us, "total": 10.0 * us})
    written = json.loads(json.dumps(latencies.as_cyclictest()))
    assert written["file_version"] == 1
    assert written["return_code"] == written["resolution_in_ns"] == 0
    assert written["num_threads"] == len(written["thread"]) == 2
    source, total = (written["thread"][number] for number in "01")
    assert (source["name"], total["name"]) == ("source", "total")
    assert source["histogram"] == {"1": 1, "2": 2}
    assert source["cycles"] - sum(source["histogram"].values()) == 1
    assert (source["min"], source["max"]) == (1, 2 * BOUND_US)
    assert source["avg"] == pytest.approx(25001.675, abs=0.01)
    assert set(source) == {
        "name", "histogram", "cycles", "min", "max", "avg", "cpu", "node"
    }  # fmt: skip
