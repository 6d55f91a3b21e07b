"""Taxels at rest: their first baseline, their noise, and taxels that never change."""

import numpy as np

from taxeld.arrays import Bools, Floats, Index
from taxeld.skin.calibration import Calibration
from taxeld.skin.drift import Slice

WINDOW = 20  # quiet readings that make a baseline
MOVED_SIGMAS = 10.0  # a wider window is not noise: 20 normal readings span 3.7 ± 0.7
SD_OF_STEP = 1.4826 / np.sqrt(2.0)  # median step between scans → sd of a reading
NOISE_MAX = 0.05  # share of full scale: a noisier taxel is of no use
MEMORY = 2000  # most scans that the running variance weighs
LEAST = 8  # scans: the spread of a shorter slice is not used
GROWTH = 2.0  # factor on the known noise: a larger spread within one slice is motion
FROZEN_SCANS = 200  # scans without a single count of change
NOISE_TELLS = 1.0  # counts: where most taxels have less noise, a still taxel may be fine


class Idle:
    """The capture: windows of readings of each taxel, until it has been quiet for one window.

    A taxel that changes in a window, or lies above its lowest level so far, was touched."""

    def __init__(self, taxels: int, full_scale: float, floor: float) -> None:
        """`floor`: a window narrower than this [counts] is never a touch."""
        self.known: Bools = np.zeros(taxels, dtype=bool)
        self._noise_max, self._floor = NOISE_MAX * full_scale, floor
        self._low = np.full(taxels, np.inf)  # the lowest level so far [counts]
        self._n = np.zeros(taxels, dtype=np.intp)
        self._window = np.zeros((WINDOW, taxels), dtype=np.uint16)

    def on_scan(self, taxels: Index, counts: Floats, busy: Bools) -> tuple[Index, Floats, Floats]:
        """Take valid counts (n,) of taxels (n,); `busy` (M,): near a touch now or shortly before; →
        the taxels whose baseline became known, their baselines, and the sd of a reading
        [counts]."""
        self._n[taxels[busy[taxels]]] = 0
        wanted = ~self.known[taxels] & ~busy[taxels]
        taxels, counts = taxels[wanted], counts[wanted]
        self._window[self._n[taxels], taxels] = counts
        self._n[taxels] += 1
        full = taxels[self._n[taxels] == WINDOW]
        window = self._window[:, full].astype(np.float64)
        mean, sd = window.mean(axis=0), window.std(axis=0, ddof=1)
        if len(full):
            self._n[full] = 0
            quiet = self._quiet(full, window) & (sd <= self._noise_max)
            full, mean, sd = full[quiet], mean[quiet], sd[quiet]
            self.known[full] = True
        return full, mean, sd

    def _quiet(self, taxels: Index, window: Floats) -> Bools:
        """(n,) whether taxels (n,) were untouched in their `window` (WINDOW, n) [counts]."""
        noise = SD_OF_STEP * np.median(np.abs(np.diff(window, axis=0)), axis=0)
        allowed = np.maximum(MOVED_SIGMAS * np.maximum(noise, np.median(noise)), self._floor)
        low = self._low[taxels] = np.minimum(self._low[taxels], np.quantile(window, 0.25, axis=0))
        level = np.median(window, axis=0)
        return np.asarray((np.ptp(window, axis=0) <= allowed) & (level - low <= allowed))


class Rest:
    """The noise of M taxels, and which of them are frozen.

    The noise comes from the capture, or a calibration, and then from every second out of contact:
    twenty readings give a standard deviation to about a sixth, so that of hundreds of taxels some
    would have a threshold of four sigmas in place of six.

    A frozen taxel's counts have stopped changing while the others still show their noise. A taxel
    that keeps its noise but does not react to touches is found by the estimator."""

    def __init__(self, taxels: int, calibration: Calibration | None) -> None:
        self.noise: Floats = np.zeros(taxels)  # (M,) sd of a reading at rest [counts]
        self._scans = np.zeros(taxels)  # (M,) scans behind each noise
        self._still = np.zeros(taxels, dtype=np.int64)  # (M,) scans without a change
        self._calibration = calibration
        self._frozen_before: Bools = np.zeros(taxels, dtype=bool)
        if calibration is not None:
            self._frozen_before = calibration.frozen
        self.frozen = self._frozen_before  # (M,) frozen now, or when the skin was calibrated

    def take(self, taxels: Index, sd: Floats) -> None:
        """Take the noise `sd` (n,) [counts] of taxels (n,) from their capture. That of a
        calibration is kept: it rests on more scans."""
        self.noise[taxels], self._scans[taxels] = sd, WINDOW
        if self._calibration is not None:
            self.noise[taxels] = self._calibration.noise_counts[taxels]
            self._scans[taxels] = MEMORY

    def stood_still(self, part: Slice, known: Bools) -> None:
        """Take a slice's readings; `known` (M,): taxels with a known noise."""
        taxels = len(known)
        self._still = np.where(part.changed[:taxels], 0, self._still + part.scans[:taxels])
        tells = known.any() and np.median(self.noise[known]) >= NOISE_TELLS
        self.frozen = self._frozen_before | (tells & (self._still >= FROZEN_SCANS))

    def varied(self, part: Slice, at_rest: Bools) -> None:
        """Take a slice's spread; only taxels `at_rest` (M,) are used."""
        scans = part.scans[: len(at_rest)]
        used = np.where(at_rest & (scans >= LEAST), scans, 0)
        variance = np.minimum(part.variance[: len(at_rest)], (GROWTH * self.noise) ** 2 + 1.0)
        share = used / np.maximum(self._scans + used, 1)
        self.noise = np.sqrt(self.noise**2 + share * (variance - self.noise**2))
        self._scans = np.minimum(self._scans + used, MEMORY)
