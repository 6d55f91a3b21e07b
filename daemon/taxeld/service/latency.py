"""How long the last scans took."""

import numpy as np

LAST = 4096  # scans, minutes of them


class Latencies:
    """A ring of the last durations, and the longest since start."""

    def __init__(self) -> None:
        self.scans = 0
        self._us = np.zeros(LAST)
        self._max_us = 0.0

    def add(self, us: float) -> None:
        self._us[self.scans % LAST] = us
        self._max_us = max(self._max_us, us)
        self.scans += 1

    def percentiles(self) -> dict[str, float]:
        """Zeros where nothing was measured."""
        p50, p99 = np.percentile(self._us[: max(min(self.scans, LAST), 1)], (50, 99)).tolist()
        return {"p50": p50, "p99": p99, "max": self._max_us}
