"""Taxels at rest: their noise, and taxels that never change.

The noise comes from the idle capture, and then from every second out of contact. The capture's
twenty readings give a standard deviation to about a sixth: among hundreds of taxels some would then
have a threshold of four sigmas in place of six.

A frozen taxel's counts have stopped changing while the others still show their noise. A taxel that
keeps its noise but does not react to touches is found by the estimator.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index
from taxeld.skin.calibration import Calibration

MEMORY = 2000  # most scans that the running variance weighs
LEAST = 8  # scans: the spread of a shorter slice is not used
GROWTH = 2.0  # factor on the known noise: a larger spread within one slice is motion
FROZEN_SCANS = 200  # scans without a single count of change
NOISE_TELLS = 1.0  # counts: where most taxels have less noise, a still taxel may be fine


class Rest:
    """Noise and frozen state of M taxels, learned and from their calibration where there is one."""

    def __init__(self, taxels: int, calibration: Calibration | None) -> None:
        self.noise: Floats = np.zeros(taxels)  # (M,) sd of a reading at rest [counts]
        self._scans = np.zeros(taxels)  # (M,) scans behind each noise
        self._still = np.zeros(taxels, dtype=np.int64)  # (M,) scans without a change
        self._calibration = calibration
        self._frozen_before: Bools = np.zeros(taxels, dtype=bool)
        if calibration is not None:
            self._frozen_before = calibration.frozen
        self.frozen = self._frozen_before  # (M,) frozen now, or when the skin was calibrated

    def take(self, taxels: Index, sd: Floats, scans: int) -> None:
        """Take the noise `sd` (n,) [counts] of taxels (n,), measured over `scans` scans. The noise
        of a calibration is kept: it rests on more scans."""
        if self._calibration is not None:
            sd, scans = self._calibration.noise_counts[taxels], MEMORY
        self.noise[taxels] = sd
        self._scans[taxels] = scans

    def stood_still(self, scans: NDArray[np.int64], changed: Bools, known: Bools) -> None:
        """Take a slice's valid readings (M,), whether they changed (M,), and the taxels with a
        known noise (M,)."""
        self._still = np.where(changed, 0, self._still + scans)
        noise = self.noise[known]
        tells = len(noise) and np.median(noise) >= NOISE_TELLS
        still = self._still >= FROZEN_SCANS if tells else np.zeros_like(changed)
        self.frozen = still | self._frozen_before

    def varied(self, variance: Floats, scans: NDArray[np.int64], at_rest: Bools) -> None:
        """Take the variances (M,) [counts²] within a slice of `scans` (M,) readings; only taxels
        `at_rest` (M,) are used."""
        used = np.where(at_rest & (scans >= LEAST), scans, 0)
        variance = np.minimum(variance, (GROWTH * self.noise) ** 2 + 1.0)
        share = used / np.maximum(self._scans + used, 1)
        self.noise = np.sqrt(self.noise**2 + share * (variance - self.noise**2))
        self._scans = np.minimum(self._scans + used, MEMORY)
