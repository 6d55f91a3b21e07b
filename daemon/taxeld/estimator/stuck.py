"""Stuck taxels: they read the same wherever the skin goes, so they tell nothing of the world."""

import numpy as np

from taxeld.arrays import Bools, Floats

SAME = 0.01  # share of full scale: a reading changes only by more than this
WAY_M = 0.1  # m that the skin moves meanwhile: no press lasts unchanged over such a way


class Stuck:
    """Follows how far each taxel was carried while it read the same value above 0."""

    def __init__(self, taxels: int) -> None:
        self._z = np.zeros(taxels)
        self._way_m = np.zeros(taxels)

    def released(self) -> None:
        """Take a scan in which nothing is read."""
        self._z[:] = self._way_m[:] = 0.0

    def on_scan(self, z: Floats, moved_m: float) -> Bools:
        """Take activations z (M,) and the skin's motion since the scan before [m]; → (M,) which
        taxels are stuck. A taxel that reads something else is free at once."""
        same = (z > 0.0) & (np.abs(z - self._z) <= SAME)
        self._way_m = np.where(same, self._way_m + moved_m, 0.0)
        self._z = np.where(same, self._z, z)
        return np.asarray(self._way_m > WAY_M)
