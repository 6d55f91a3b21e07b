"""Taxels that read the same wherever the skin goes: they tell of themselves, not of the world."""

import numpy as np

from taxeld.arrays import Bools, Floats

SAME = 0.01  # of full scale: a reading within this of what it was has not changed
WAY_M = 0.1  # that the skin goes meanwhile: no press lasts so unchanged over such a way


class Stuck:
    """Follows how far each taxel was carried while it read the same, other than nothing."""

    def __init__(self, taxels: int) -> None:
        self._z = np.zeros(taxels)
        self._way_m = np.zeros(taxels)

    def released(self) -> None:
        """A scan in which nothing is read."""
        self._z[:] = self._way_m[:] = 0.0

    def on_scan(self, z: Floats, moved_m: float) -> Bools:
        """Activations z (M,), and how far the skin went since the scan before → (M,) which are
        stuck; one that reads anything else is so no more."""
        same = (z > 0.0) & (np.abs(z - self._z) <= SAME)
        self._way_m = np.where(same, self._way_m + moved_m, 0.0)
        self._z = np.where(same, self._z, z)
        return np.asarray(self._way_m > WAY_M)
