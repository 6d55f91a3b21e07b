"""Taxels that read below their baseline: a baseline that is too high, or a dip of the readings.

Pressure is never negative, so a baseline that stays above the readings is lowered to them. Readings
that had only dipped return, and would then look like a touch for ever. So once all taxels that were
lowered together read what they did before, their baselines return too.
"""

import numpy as np

from taxeld.arrays import Bools, Floats, Index

BELOW_SLICES = 2  # slices in a row below the threshold that show a baseline too high
BACK_SLICES = 3  # slices in a row with all taxels back that show a mere dip
# share of the threshold: a reading this near to the old one is back; no press brings all there
BACK_SHARE = 0.25


class Dips:
    """The lowered baselines of M taxels."""

    def __init__(self, taxels: int) -> None:
        self.lowered = 0  # baselines lowered, since start
        self._below = np.zeros(taxels, dtype=np.int64)  # (M,) slices in a row below the threshold
        self._by = np.zeros(taxels)  # (M,) amount by which each was lowered [counts]
        self._group = np.zeros(taxels, dtype=np.int64)  # (M,) number of the group lowered together
        self._back: dict[int, int] = {}  # group → slices in a row with the whole group back

    def forget(self, taxels: Index) -> None:
        """Taxels (n,) have a new baseline."""
        self._below[taxels] = 0
        self._by[taxels] = 0.0

    def lower(self, gap: Floats, below: Bools) -> Bools:
        """`gap` (M,): baselines over the slice's mean [counts]; `below` (M,): whether by more than
        the threshold; → (M,) baselines to be lowered to the mean."""
        self._below = np.where(below, self._below + 1, 0)
        wrong: Bools = self._below >= BELOW_SLICES
        if wrong.any():
            self._by[wrong] += gap[wrong]
            self._group[wrong] = self.lowered + 1  # number of a new group
            self._below[wrong] = 0
            self.lowered += int(wrong.sum())
        return wrong

    def rise(self, over: Floats, usable: Bools, threshold: Floats) -> Floats:
        """`over` (M,): the slice's mean over the baselines [counts]; `usable` (M,); `threshold`
        (M,) [counts]; → (M,) by how much to raise the baselines [counts]."""
        risen = np.zeros_like(self._by)
        lowered = self._by > 0.0
        if not lowered.any():
            return risen
        away = np.abs(over - self._by) > BACK_SHARE * threshold
        for group in np.unique(self._group[lowered]).tolist():
            those = lowered & (self._group == group)
            is_back = usable[those].all() and not away[those].any()
            self._back[group] = self._back.get(group, 0) + 1 if is_back else 0
            if self._back[group] >= BACK_SLICES:
                risen[those] = self._by[those]
                self._by[those] = 0.0
                del self._back[group]
        return risen
