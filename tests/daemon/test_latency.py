"""Histograms of latency: exact counts, percentiles from above, cyclictest's form."""

import json
import time
from email.utils import format_datetime, parsedate_to_datetime
from typing import Any

import numpy as np
import pytest

from taxeld.service.latency import BOUND_US, Latencies

STAGES = ("skin", "filter")


def filled(values: list[float]) -> Latencies:
    """With these durations of `filter`; those of `skin` are twice as long."""
    latencies = Latencies(STAGES)
    for us in values:
        latencies.add({"skin": 2.0 * us, "filter": us})
    return latencies


def thread(latencies: Latencies) -> dict[str, Any]:
    """`filter` in cyclictest's form."""
    found: dict[str, Any] = latencies.as_cyclictest()["thread"]["1"]
    return found


def quantiles_us(latencies: Latencies) -> tuple[float, float]:
    found = latencies.percentiles()["filter"]
    return found["p50"], found["p99"]


def test_every_duration_is_counted_once() -> None:
    found = thread(filled([0.0, 0.9, 17.0, 17.99, 18.0, BOUND_US - 0.5, BOUND_US, 1e9]))
    assert found["histogram"] == {"0": 2, "17": 2, "18": 1, str(BOUND_US - 1): 1}
    assert found["cycles"] == 8
    assert (found["min"], found["max"]) == (0, 10**9)


def test_a_histogram_tells_its_dates_as_cyclictest_does() -> None:
    before = time.time()
    told = Latencies(STAGES).as_cyclictest()
    for name in ("start_time", "end_time"):
        date = parsedate_to_datetime(told[name])
        assert format_datetime(date) == told[name], "RFC 2822"
        assert before - 1.0 <= date.timestamp() <= time.time()


def test_nothing_measured_is_zeros() -> None:
    empty = Latencies(STAGES)
    nothing = {"p50": 0.0, "p99": 0.0, "max": 0.0}
    assert empty.percentiles() == {"skin": nothing, "filter": nothing}
    found = thread(empty)
    assert found["histogram"] == {}
    assert [found[key] for key in ("cycles", "min", "avg", "max")] == [0, 0, 0.0, 0]


@pytest.mark.parametrize("seed", range(3))
def test_percentiles_are_those_of_the_values_to_a_microsecond(seed: int) -> None:
    values = np.random.default_rng(seed).gamma(2.0, 300.0, 5000)
    exact = np.quantile(values, (0.5, 0.99), method="inverted_cdf")
    found = quantiles_us(filled(values.tolist()))
    assert (found >= exact).all()
    assert (found <= exact + 1.0).all()


def test_percentiles_in_the_overflow_are_the_maximum() -> None:
    assert quantiles_us(filled([1.0] * 9 + [2.0 * BOUND_US])) == (2.0, 2.0 * BOUND_US)
    assert quantiles_us(filled([3.25])) == (3.25, 3.25)


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
    assert set(source) == {"name", "histogram", "cycles", "min", "max", "avg", "cpu", "node"}
