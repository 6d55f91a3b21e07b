"""The idle capture: the mean and the noise of each taxel's readings while nothing touches it.

A taxel's baseline is the mean of a window of scans in which it was quiet. A taxel that changes in a
window, or lies above its lowest level so far, was touched, and the capture begins again. After
`PATIENCE` such windows the quiet taxels get their baselines; the others have none until they have
had a quiet window of their own.
"""

import numpy as np

from taxeld.arrays import Bools, Floats, Index

PATIENCE = 5  # restarts of the capture before touched taxels are left out
MOVED_SIGMAS = 10.0  # a wider window is not noise: 20 normal readings span 3.7 ± 0.7
SD_OF_STEP = 1.4826 / np.sqrt(2.0)  # median step between scans → sd of a reading
NOISE_MAX = 0.05  # share of full scale: a noisier taxel is of no use
NONE = np.empty(0, dtype=np.intp)


class Idle:
    """Windows of readings for each taxel, until each has been quiet for one window."""

    def __init__(self, taxels: int, scans: int, full_scale: float, floor: float) -> None:
        """`scans`: length of a window; `floor`: a window narrower than this [counts] is never a
        touch."""
        self.known: Bools = np.zeros(taxels, dtype=bool)
        self.mean: Floats = np.zeros(taxels)
        self.noise: Floats = np.zeros(taxels)  # (M,) sd of a reading [counts]
        self.begun_again = 0
        self._noise_max = NOISE_MAX * full_scale
        self._floor = floor
        self._low = np.full(taxels, np.inf)  # the lowest level so far [counts]
        self._n = np.zeros(taxels, dtype=np.intp)
        self._window = np.zeros((scans, taxels), dtype=np.uint16)

    def on_scan(self, taxels: Index, counts: Floats, busy: Bools) -> Index:
        """Take valid counts (n,) of taxels (n,); `busy` (M,): near a touch now or shortly before; →
        the taxels whose baseline became known."""
        wanted = ~self.known[taxels]
        if not wanted.any():
            return NONE
        taxels, counts = taxels[wanted], counts[wanted]
        touched = busy[taxels]
        self._n[taxels[touched]] = 0
        taxels, counts = taxels[~touched], counts[~touched]
        self._window[self._n[taxels], taxels] = counts
        self._n[taxels] += 1
        full = taxels[self._n[taxels] == len(self._window)]
        return self._judge(full) if len(full) else NONE

    def _judge(self, taxels: Index) -> Index:
        """Judge the full windows of taxels (n,); → the taxels that were quiet."""
        window = self._window[:, taxels].astype(np.float64)
        self._n[taxels] = 0
        sd = SD_OF_STEP * np.median(np.abs(np.diff(window, axis=0)), axis=0)
        allowed = np.maximum(MOVED_SIGMAS * np.maximum(sd, np.median(sd)), self._floor)
        low = self._low[taxels] = np.minimum(self._low[taxels], np.quantile(window, 0.25, axis=0))
        quiet = (np.ptp(window, axis=0) <= allowed) & (np.median(window, axis=0) - low <= allowed)
        if not quiet.all() and self.begun_again < PATIENCE:
            self.begun_again += 1
            self._n[:] = 0
            return NONE
        noise = window.std(axis=0, ddof=1)
        quiet &= noise <= self._noise_max
        found: Index = taxels[quiet]
        self.known[found] = True
        self.mean[found], self.noise[found] = window.mean(axis=0)[quiet], noise[quiet]
        return found
