"""How long each stage of a tick took since start, in the form that `cyclictest --json` writes."""

import os
import platform
import sys
import time
from array import array
from math import ceil
from typing import Any

import numpy as np

from taxeld import __version__

BOUND_US = 50_000  # buckets of 1 µs; longer ones are counted, and known by their maximum
QUANTILES = (0.5, 0.99)
ADDED_MAX = 1000  # that wait to be sorted in


class Histogram:
    """Durations; neither adding one nor asking for a quantile searches or allocates."""

    def __init__(self) -> None:
        self.cycles = 0
        self.overflow = 0  # of them: BOUND_US or more
        self.max_us = 0.0
        self._min_us = float("inf")
        self._sum_us = 0.0
        self._counts = array("Q", bytes(8 * BOUND_US))
        self._ranks = [_Rank(quantile, self._counts) for quantile in QUANTILES]

    def add(self, us: float) -> None:
        self.cycles += 1
        self._sum_us += us
        self.max_us = max(self.max_us, us)
        self._min_us = min(self._min_us, us)
        bucket = int(us)
        if bucket < BOUND_US:
            self._counts[bucket] += 1
        else:
            self.overflow += 1
        for rank in self._ranks:
            rank.added(bucket, self.cycles)

    @property
    def min_us(self) -> float:
        return self._min_us if self.cycles else 0.0

    @property
    def mean_us(self) -> float:
        return self._sum_us / self.cycles if self.cycles else 0.0

    def quantiles_us(self) -> list[float]:
        """The QUANTILES, to a microsecond from above; in the overflow, the maximum."""
        return [
            min(rank.bucket + 1.0, self.max_us) if rank.bucket < BOUND_US else self.max_us
            for rank in self._ranks
        ]

    def counts(self) -> dict[str, int]:
        """Whole microseconds → how often; those that occurred."""
        filled = np.frombuffer(self._counts, dtype=np.uint64)[: int(self.max_us) + 1]
        return {str(us): int(filled[us]) for us in np.flatnonzero(filled)}


class _Rank:
    """The bucket of a quantile, which moves on as durations are added; BOUND_US is the overflow."""

    def __init__(self, quantile: float, counts: "array[int]") -> None:
        self.bucket = 0
        self._quantile = quantile
        self._counts = counts
        self._below = 0  # durations in lower buckets

    def added(self, bucket: int, cycles: int) -> None:
        rank = ceil(self._quantile * cycles)
        self._below += bucket < self.bucket
        while self._below >= rank:
            self.bucket -= 1
            self._below -= self._counts[self.bucket]
        while self.bucket < BOUND_US and self._below + self._counts[self.bucket] < rank:
            self._below += self._counts[self.bucket]
            self.bucket += 1


class Latencies:
    """A histogram a stage. What is added is sorted in when it is asked for, or has become much:
    not while a scan is under way, and for less when it is many at once."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        self._added: list[dict[str, float]] = []
        self._start = time.time()
        self._stages = {stage: Histogram() for stage in stages}

    def add(self, us: dict[str, float]) -> None:
        """Take durations, which are not changed any more."""
        self._added.append(us)
        if len(self._added) >= ADDED_MAX:
            self._sort_in()

    def percentiles(self) -> dict[str, dict[str, float]]:
        """Since start; zeros where nothing was measured."""
        self._sort_in()
        found = {}
        for stage, histogram in self._stages.items():
            p50, p99 = histogram.quantiles_us()
            found[stage] = {"p50": p50, "p99": p99, "max": histogram.max_us}
        return found

    def as_cyclictest(self) -> dict[str, Any]:
        """What `cyclictest --json --histogram=50000` writes: a stage stands where a thread does.

        Counts are by whole microseconds; `cycles` beyond their sum went over the bound.
        """
        self._sort_in()
        return {
            "file_version": 1,
            "cmdline": " ".join(sys.argv),
            "taxeld_version": __version__,
            "start_time": _date(self._start),
            "end_time": _date(time.time()),
            "return_code": 0,
            "sysinfo": _sysinfo(),
            "num_threads": len(self._stages),
            "resolution_in_ns": 0,  # as cyclictest has it: microseconds
            "thread": {
                str(number): {
                    "name": stage,
                    "histogram": histogram.counts(),
                    "cycles": histogram.cycles,
                    "min": int(histogram.min_us),
                    "max": int(histogram.max_us),
                    "avg": round(histogram.mean_us, 2),
                    "cpu": cpus.pop() if len(cpus := os.sched_getaffinity(0)) == 1 else -1,
                    "node": 0,
                }
                for number, (stage, histogram) in enumerate(self._stages.items())
            },
        }

    def _sort_in(self) -> None:
        added, self._added = self._added, []
        for stage, histogram in self._stages.items():
            for us in added:
                histogram.add(us[stage])


def _date(t: float) -> str:
    return time.strftime("%a, %d %b %Y %H:%M:%S %z", time.localtime(t))


def _sysinfo() -> dict[str, str | int]:
    system = platform.uname()
    return {
        "sysname": system.system,
        "release": system.release,
        "version": system.version,
        "machine": system.machine,
        "realtime": int("PREEMPT_RT" in system.version),
    }
