"""Taxels whose counts have stopped changing while the others still show their noise.

A taxel that keeps its noise but does not react to touches is found elsewhere (`estimator.stuck`).
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats

FROZEN_SCANS = 200  # scans without a single count of change
NOISE_TELLS = 1.0  # counts: where most taxels have less noise, a still taxel may be fine


class Frozen:
    """For how many scans each of M taxels has read the same, and which are frozen."""

    def __init__(self, taxels: int) -> None:
        self.mask: Bools = np.zeros(taxels, dtype=bool)
        self._still = np.zeros(taxels, dtype=np.int64)

    def on_slice(self, scans: NDArray[np.int64], changed: Bools, noise: Floats) -> None:
        """Take valid readings (M,) since the last slice, whether they changed (M,), and the idle
        noise (n,) [counts] of the taxels that have a baseline."""
        self._still = np.where(changed, 0, self._still + scans)
        if len(noise) and np.median(noise) >= NOISE_TELLS:
            self.mask = self._still >= FROZEN_SCANS
        else:
            self.mask[:] = False
