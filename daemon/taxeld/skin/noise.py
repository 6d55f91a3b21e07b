"""The idle noise of each taxel: from the capture, and then from every second out of contact.

The capture's twenty readings give a standard deviation to about a sixth. Among hundreds of taxels
some would then have a threshold of four sigmas in place of six.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Index

MEMORY = 2000  # most scans that the running variance weighs
LEAST = 8  # scans: the spread of a shorter slice is not used
GROWTH = 2.0  # factor on the known noise: a larger spread within one slice is motion


class IdleNoise:
    """The standard deviation of M taxels' readings [counts]."""

    def __init__(self, taxels: int) -> None:
        self.sd: Floats = np.zeros(taxels)
        self._scans = np.zeros(taxels)  # (M,) scans behind each value

    def take(self, taxels: Index, sd: Floats, scans: int) -> None:
        """Set the noise `sd` (n,) [counts] of taxels (n,), measured over `scans` scans."""
        self.sd[taxels] = sd
        self._scans[taxels] = scans

    def on_slice(self, variance: Floats, scans: NDArray[np.int64], at_rest: Bools) -> None:
        """Take the variances (M,) [counts²] within a slice of `scans` (M,) readings; only taxels
        `at_rest` (M,) are used."""
        used = np.where(at_rest & (scans >= LEAST), scans, 0)
        variance = np.minimum(variance, (GROWTH * self.sd) ** 2 + 1.0)
        share = used / np.maximum(self._scans + used, 1)
        self.sd = np.sqrt(self.sd**2 + share * (variance - self.sd**2))
        self._scans = np.minimum(self._scans + used, MEMORY)
