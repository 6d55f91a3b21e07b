"""How long each stage of a scan took since start, in the form that `cyclictest --json` writes."""

import math
import os
import platform
import sys
import time
from typing import Any

import numpy as np

from taxeld import __version__
from taxeld.arrays import Index

BOUND_US = 50_000  # bins of 1 µs; longer durations are counted, and known by their maximum
QUANTILES = {"p50": 0.5, "p99": 0.99}


class Latencies:
    """A histogram for each stage."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        self.scans = 0
        self._stages = stages
        self._start = time.time()
        self._bins = np.zeros((len(stages), BOUND_US + 1), dtype=np.int64)  # the last is for longer
        self._rows = np.arange(len(stages))
        self._sum_us, self._max_us = np.zeros(len(stages)), np.zeros(len(stages))

    def add(self, us: dict[str, float]) -> None:
        """Take a scan's duration of each stage."""
        took = np.array([us[stage] for stage in self._stages])
        self.scans += 1
        self._sum_us += took
        self._max_us = np.maximum(self._max_us, took)
        self._bins[self._rows, np.minimum(took, BOUND_US).astype(np.intp)] += 1

    def percentiles(self) -> dict[str, dict[str, float]]:
        """Since start, rounded up to a microsecond; zeros where nothing was measured."""
        found: dict[str, dict[str, float]] = {}
        for stage, bins, longest in zip(
            self._stages, self._bins, self._max_us.tolist(), strict=True
        ):
            up_to = bins[: int(min(longest, BOUND_US)) + 1].cumsum()
            ends = [self._end_us(up_to, share) for share in QUANTILES.values()]
            within = [min(end, longest) for end in ends]
            found[stage] = dict(zip(QUANTILES, within, strict=True)) | {"max": longest}
        return found

    def _end_us(self, up_to: Index, share: float) -> float:
        """Where the bin ends in which a share of all scans is reached. `up_to` (bins,): counts of
        each bin and all before it."""
        us = int(up_to.searchsorted(math.ceil(share * self.scans)))
        return us + 1.0 if us < BOUND_US else math.inf

    def as_cyclictest(self) -> dict[str, Any]:
        """The form of `cyclictest --json --histogram=50000`: a stage stands in place of a thread.

        Counts are by whole microseconds; `cycles` beyond their sum took BOUND_US or longer.
        """
        system, cpus = platform.uname(), os.sched_getaffinity(0)
        counts = self._bins
        filled = [np.flatnonzero(each) for each in counts]
        return {
            "file_version": 1,
            "cmdline": " ".join(sys.argv),
            "taxeld_version": __version__,
            "start_time": _date(self._start),
            "end_time": _date(time.time()),
            "return_code": 0,
            "sysinfo": {
                "sysname": system.system,
                "release": system.release,
                "version": system.version,
                "machine": system.machine,
                "realtime": int("PREEMPT_RT" in system.version),
            },
            "num_threads": len(self._stages),
            "resolution_in_ns": 0,  # as cyclictest has it: microseconds
            "thread": {
                str(k): {
                    "name": stage,
                    "histogram": {str(us): int(counts[k, us]) for us in filled[k] if us < BOUND_US},
                    "cycles": self.scans,
                    "min": int(filled[k][0]) if self.scans else 0,
                    "max": int(self._max_us[k]),
                    "avg": round(float(self._sum_us[k]) / max(self.scans, 1), 2),
                    "cpu": next(iter(cpus)) if len(cpus) == 1 else -1,
                    "node": 0,
                }
                for k, stage in enumerate(self._stages)
            },
        }


def _date(t: float) -> str:
    return time.strftime("%a, %d %b %Y %H:%M:%S %z", time.localtime(t))
