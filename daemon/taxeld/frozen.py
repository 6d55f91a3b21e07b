"""Taxels whose converter has stopped: not a single count of change while the others' noise goes on.

At the level of counts, over seconds, at rest or not; `stuck` looks at activations while the sensor
moves, and finds what still has its noise.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.idle import Bools, Floats

FROZEN_SCANS = 200  # without a count of change
NOISE_TELLS = 1.0  # counts: with less noise than this in most taxels, stillness says nothing


class Frozen:
    """Follows for how many scans each taxel has read the same."""

    def __init__(self, taxels: int) -> None:
        self.mask: Bools = np.zeros(taxels, dtype=bool)
        self._still = np.zeros(taxels, dtype=np.int64)

    def on_slice(self, scans: NDArray[np.int64], changed: Bools, noise: Floats) -> None:
        """Valid readings since the last slice and whether they changed, of each taxel (M,); the
        idle noise [counts] of those that have a baseline."""
        self._still = np.where(changed, 0, self._still + scans)
        if len(noise) and np.median(noise) >= NOISE_TELLS:
            self.mask = self._still >= FROZEN_SCANS
        else:
            self.mask[:] = False
