"""Taxels at rest: their noise, and taxels that never change."""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index
from taxeld.skin.calibration import Calibration
from taxeld.skin.frozen import Frozen
from taxeld.skin.noise import MEMORY, IdleNoise


class Rest:
    """Noise and frozen state of M taxels, learned and from their calibration where there is one."""

    def __init__(self, taxels: int, calibration: Calibration | None) -> None:
        self._noise = IdleNoise(taxels)
        self._frozen = Frozen(taxels)
        self._calibration = calibration
        self._frozen_before: Bools = np.zeros(taxels, dtype=bool)
        if calibration is not None:
            self._frozen_before = calibration.frozen

    @property
    def noise(self) -> Floats:
        """(M,) sd of a reading at rest [counts]."""
        return self._noise.sd

    @property
    def frozen(self) -> Bools:
        """(M,) whether a taxel is frozen now, or was when the skin was calibrated."""
        return self._frozen.mask | self._frozen_before

    def take(self, taxels: Index, sd: Floats, scans: int) -> None:
        """Take the noise `sd` (n,) [counts] of taxels (n,), measured over `scans` scans. The noise
        of a calibration is kept: it rests on more scans."""
        self._noise.take(taxels, sd, scans)
        if self._calibration is not None:
            self._noise.take(taxels, self._calibration.noise_counts[taxels], MEMORY)

    def stood_still(self, scans: NDArray[np.int64], changed: Bools, known: Bools) -> None:
        """Take a slice's valid readings (M,), whether they changed (M,), and the taxels with a
        known noise (M,)."""
        self._frozen.on_slice(scans, changed, self._noise.sd[known])

    def varied(self, variance: Floats, scans: NDArray[np.int64], at_rest: Bools) -> None:
        """Take the variances (M,) [counts²] within a slice; only taxels `at_rest` (M,) are used."""
        self._noise.on_slice(variance, scans, at_rest)
