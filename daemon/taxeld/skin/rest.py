"""Taxels at rest: the noise of each, and which of them never change."""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index
from taxeld.skin.calibration import Calibration
from taxeld.skin.frozen import Frozen
from taxeld.skin.noise import MEMORY, IdleNoise


class Rest:
    """M taxels, by what is learned of them, and by their calibration where there is one."""

    def __init__(self, taxels: int, calibration: Calibration | None) -> None:
        self._noise = IdleNoise(taxels)
        self._frozen = Frozen(taxels)
        self._calibration = calibration
        self._frozen_before: Bools = np.zeros(taxels, dtype=bool)
        if calibration is not None:
            self._frozen_before = calibration.frozen

    @property
    def noise(self) -> Floats:
        """(M,) counts."""
        return self._noise.sd

    @property
    def frozen(self) -> Bools:
        """(M,) now, or when the skin was calibrated."""
        return self._frozen.mask | self._frozen_before

    def take(self, taxels: Index, sd: Floats, scans: int) -> None:
        """The noise of some taxels, from so many scans. That of a calibration rests on more."""
        self._noise.take(taxels, sd, scans)
        if self._calibration is not None:
            self._noise.take(taxels, self._calibration.noise_counts[taxels], MEMORY)

    def stood_still(self, scans: NDArray[np.int64], changed: Bools, known: Bools) -> None:
        """Valid readings of a slice (M,), whether they changed, and which taxels have a noise."""
        self._frozen.on_slice(scans, changed, self._noise.sd[known])

    def varied(self, variance: Floats, scans: NDArray[np.int64], at_rest: Bools) -> None:
        """The variance within a slice (M,), used of taxels that were `at_rest`."""
        self._noise.on_slice(variance, scans, at_rest)
