"""How much each taxel's reading varies by itself: from the idle capture, and better ever after.

Twenty readings tell a standard deviation to a sixth of it: of hundreds of taxels, some would have a
threshold of four sigmas where six are meant. Every second out of contact tells more.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.idle import Bools, Floats, Index

MEMORY = 2000  # scans: what is older has faded
LEAST = 8  # scans of a slice that say something of their spread
GROWTH = 2.0  # times what is known: more in one slice is no noise but a move


class Noise:
    """The standard deviation of M taxels' readings [counts]."""

    def __init__(self, taxels: int) -> None:
        self.sd: Floats = np.zeros(taxels)
        self._scans = np.zeros(taxels)

    def take(self, taxels: Index, sd: Floats, scans: int) -> None:
        """The noise of some taxels, as so many scans told it."""
        self.sd[taxels] = sd
        self._scans[taxels] = scans

    def on_slice(self, variance: Floats, scans: NDArray[np.int64], at_rest: Bools) -> None:
        """The variance within a slice of so many scans (M,), of taxels that were `at_rest`."""
        told = np.where(at_rest & (scans >= LEAST), scans, 0)
        variance = np.minimum(variance, (GROWTH * self.sd) ** 2 + 1.0)
        share = told / np.maximum(self._scans + told, 1)
        self.sd = np.sqrt(self.sd**2 + share * (variance - self.sd**2))
        self._scans = np.minimum(self._scans + told, MEMORY)
